"""``python -m trompe_client.cli.child`` is ``trompe``, and ends with its parent."""

from trompe_client.cli.group import main
from trompe_shared.parent import end_with_parent

end_with_parent()
main(prog_name="trompe")
