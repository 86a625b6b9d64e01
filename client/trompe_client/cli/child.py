"""``python -m trompe_client.cli.child`` is ``trompe``, and ends with its parent."""

from trompe_client.cli.group import main
from trompe_shared.parent import end_with_parent

if __name__ == "__main__":  # attack workers import it again
    end_with_parent()
    main(prog_name="trompe")
