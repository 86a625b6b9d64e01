"""``python -m trompe_renderer`` is ``trompe render``."""

from trompe_renderer.command import render

render(prog_name="trompe render")
