"""Run a ``trompe`` command as a child process that ends with its parent.

``python -m trompe_server.system.child render --port 0``.
"""

import sys
from importlib.metadata import entry_points

from trompe_shared.errors import TrompeError
from trompe_shared.parent import end_with_parent


def main(arguments: list[str]) -> None:
    """Run the command named by the first argument with the remaining arguments."""
    end_with_parent()
    name, *rest = arguments
    command = entry_points(group="trompe.commands")[name].load()
    try:
        command.main(rest, prog_name=f"trompe {name}")
    except TrompeError as error:
        sys.exit(f"Error: {error}")


if __name__ == "__main__":
    main(sys.argv[1:])
