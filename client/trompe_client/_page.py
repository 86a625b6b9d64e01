"""A result as a page for a notebook or a file."""

from dataclasses import dataclass
from html import escape
from typing import Final

HEIGHT: Final = 900
"""Pixels in a notebook."""


@dataclass(frozen=True)
class ResultPage:
    """One HTML page with everything inside. A notebook shows it; ``html`` is its text, to be written to a file."""

    html: str

    def _repr_html_(self) -> str:
        """The page in a frame that can reach neither the notebook nor a network."""
        style = f"width: 100%; height: {HEIGHT}px; border: 0"
        return f'<iframe sandbox="allow-scripts" style="{style}" srcdoc="{escape(self.html)}"></iframe>'
