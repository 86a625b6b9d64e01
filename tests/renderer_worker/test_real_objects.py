"""The paper's objects, if TROMPE_ASSETS names them: each is read, in the picture, and textured."""

import json
import os
from pathlib import Path

import numpy as np
import pytest

from trompe_server.renderers import SailenvTarget
from trompe_shared.geometry import Camera, Light, View
from trompe_shared.object3d import load_object

ASSETS = Path(os.environ.get("TROMPE_ASSETS", "none")) / "objects"
NAMES = sorted(path.name for path in ASSETS.iterdir() if path.is_dir()) if ASSETS.is_dir() else ["none"]

pytestmark = [
    pytest.mark.assets,
    pytest.mark.skipif(not ASSETS.is_dir(), reason="TROMPE_ASSETS does not name the folder with the real objects"),
]


@pytest.mark.parametrize("name", NAMES)
def test_a_real_object_is_in_the_picture_and_shows_its_texture(target: SailenvTarget, name: str) -> None:
    obj = load_object(ASSETS / name)
    facts = json.loads((ASSETS / "objects.json").read_text())[name]
    cameras = [Camera(facts["distance"], azimuth, facts["elevation_range"][1]) for azimuth in (0.0, 120.0)]
    images = target.render(obj, [View(camera, background=(0, 255, 0)) for camera in cameras], size=(96, 96))
    shown = (images != (0, 255, 0)).any(axis=-1)
    assert 0.01 < shown.mean() < 0.9
    grey = obj.with_textures({file: np.full((4, 4, 3), 128, np.uint8) for file in obj.textures})
    repainted = target.render(grey, [View(camera, background=(0, 255, 0)) for camera in cameras], size=(96, 96))
    assert ((images != repainted).any(axis=-1)[shown]).mean() > 0.9


@pytest.mark.skipif("toilet" not in NAMES, reason="there is no toilet")
def test_smooth_lit_porcelain_has_no_stripes_of_its_own_shadow(
    target: SailenvTarget, shadowless_worker: tuple[str, int]
) -> None:
    obj, view = load_object(ASSETS / "toilet"), View(Camera(1.2, 0.0, 20.0), Light(30, 20, 0.6, 0.2))
    other = SailenvTarget(*shadowless_worker)
    shaded, plain = (t.render(obj, [view], size=(96, 96))[0].astype(int) for t in (target, other))
    other.close()
    cistern = (plain - shaded)[20:55, 25:70]
    assert cistern.max() <= 3
