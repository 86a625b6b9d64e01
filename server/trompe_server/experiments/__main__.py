"""``python -m trompe_server.experiments``."""

from trompe_server.experiments.commands import main

main(prog_name="python -m trompe_server.experiments")
