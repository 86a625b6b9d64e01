"""Alpha-tested textures for pyrender, which knows the alpha mode MASK but draws it as if it were opaque.

Import this before the first picture: from then on fragments whose alpha is below the cutoff are not drawn. Textures
without alpha have an alpha of 1, so that opaque surfaces stay as they are. Shadows are still those of whole surfaces.
"""

from typing import Any, Final

from pyrender.shader_program import ShaderProgram

from trompe_shared.errors import RendererError
from trompe_shared.opacity import CUTOFF

__all__: list[str] = []

SHADER: Final = "mesh.frag"
READ: Final = "base_color = base_color * srgb_to_linear(texture(material.base_color_texture, uv_0));"
"""The line of pyrender's shader that reads the albedo."""

_load = ShaderProgram._load


def _load_with_test(program: Any, file: str) -> str:
    text: str = _load(program, file)
    if not file.endswith(SHADER):
        return text
    if text.count(READ) != 1:
        raise RendererError(
            f"pyrender's {SHADER} is not the one of version 0.1.45: it reads the albedo in another way."
        )
    return text.replace(READ, f"{READ}\n    if (base_color.a < {CUTOFF}) discard;")


ShaderProgram._load = _load_with_test
