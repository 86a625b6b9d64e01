"""The command ``trompe``: one module for each subject, imported when one of its commands is called."""

from trompe_client.cli.group import main

__all__ = ["main"]
