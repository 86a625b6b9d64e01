"""Model files as a user names them."""

from pathlib import Path

import pytest
from PIL import Image

from trompe_shared.local_files import PICTURE_SUFFIXES, model_file
from trompe_shared.object3d import IMAGE_FORMATS, unzip


@pytest.mark.parametrize("suffix", [".png", ".tga", ".TIF", ".gif"])
def test_a_mesh_takes_the_textures_beside_it_along(tmp_path: Path, suffix: str) -> None:
    for name in ("mug.obj", "mug.mtl", f"paint{suffix}", "notes.doc"):
        (tmp_path / name).write_bytes(name.encode())
    name, content = model_file(tmp_path / "mug.obj")
    assert isinstance(content, bytes)
    assert name == "mug.zip"
    assert set(unzip(content)) == {"mug.obj", "mug.mtl", f"paint{suffix}"}


def test_pictures_are_those_that_textures_may_be() -> None:
    assert {Image.registered_extensions()[suffix] for suffix in PICTURE_SUFFIXES} == set(IMAGE_FORMATS)
