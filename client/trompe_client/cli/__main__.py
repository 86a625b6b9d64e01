"""``python -m trompe_client.cli`` is ``trompe``."""

from trompe_client.cli.group import main

main(prog_name="trompe")
