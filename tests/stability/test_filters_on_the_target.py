"""Unusual filters of the real renderer: anisotropic ones, and pictures shifted by a part of a pixel.

The default sampling model mispredicts them; calibration finds a better one from images alone.
"""

from collections.abc import Callable, Iterator, Sequence
from contextlib import closing

import numpy as np
import pytest
from numpy.typing import NDArray

from tests.surfaces import object_of, quad
from tests.worker_process import started
from trompe_server.renderers import SailenvTarget
from trompe_server.surrogate import SamplingModel, curve_surrogate, prepare_geometry
from trompe_server.surrogate.calibration import CURVE_GREYS, calibrate, painted_grey, painted_noise
from trompe_server.surrogate.fidelity import Fidelity, measure_fidelity
from trompe_shared.geometry import Camera, View
from trompe_shared.object3d import Object3D
from trompe_shared.shipped import shipped_objects

Image8 = NDArray[np.uint8]
Ask = Callable[[Object3D, Sequence[View]], Image8]
SIZE = (96, 96)
MUG = shipped_objects()["mug"]
AROUND = [View(Camera(MUG.distance, azimuth, elevation)) for azimuth, elevation in ((0, 5), (70, 40), (200, 20))]
ASLANT = [View(Camera(0.4, azimuth, elevation)) for azimuth, elevation in ((60, 0), (70, 10), (10, 65), (-72, 5))]


def found(obj: Object3D, views: Sequence[View], ask: Ask) -> tuple[SamplingModel, Fidelity, Fidelity]:
    """The calibrated sampling model, its fidelity and the default model's, on another repaint."""
    clean = ask(obj, views)
    sampling = calibrate(obj, views, clean, ask, wanted="curve", generator=np.random.default_rng(0)).sampling
    probes = np.stack([ask(painted_grey(obj, grey), views) for grey in CURVE_GREYS])
    repainted = painted_noise(obj, np.random.default_rng(1))
    images = ask(repainted, views)

    def fidelity(model: SamplingModel) -> Fidelity:
        geometry = prepare_geometry(obj, views, size=SIZE, sampling=model)
        surrogate = curve_surrogate(geometry, obj, views, clean, CURVE_GREYS, probes)
        return measure_fidelity(surrogate, obj, clean, repainted, images)

    return sampling, fidelity(sampling), fidelity(SamplingModel())


@pytest.fixture(scope="module")
def anisotropic() -> Iterator[Ask]:
    with started("--set", "anisotropy=16") as running, closing(SailenvTarget(*running.address, timeout=240)) as target:
        yield lambda obj, views: target.render(obj, views, size=SIZE)


@pytest.mark.parametrize("shown", ["plane", pytest.param("mug", marks=pytest.mark.thorough)])
def test_an_anisotropic_filter_is_found(shown: str, anisotropic: Ask, mug: Object3D) -> None:
    texture = np.random.default_rng(0).integers(40, 216, (160, 160, 3), dtype=np.uint8)
    plane = object_of(quad(texture, half=0.12))
    obj, views = (plane, ASLANT) if shown == "plane" else (mug, AROUND)
    sampling, fidelity, usual = found(obj, views, anisotropic)
    assert sampling.anisotropy > 1
    assert usual.mean()["correlation"] < 0.9
    assert fidelity.mean()["correlation"] >= 0.98
    assert fidelity.mean()["slope"] == pytest.approx(1, abs=0.05)
    assert fidelity.good_enough


def test_no_anisotropy_and_no_shift_are_found_without_them(target: SailenvTarget, mug: Object3D) -> None:
    sampling, fidelity, _ = found(mug, AROUND, lambda obj, views: target.render(obj, views, size=SIZE))
    assert (sampling.anisotropy, sampling.shift) == (1, (0.0, 0.0))
    assert fidelity.mean()["correlation"] >= 0.98


@pytest.mark.thorough
@pytest.mark.parametrize(("column", "row"), [(0, 0), (1, 0)])
def test_a_picture_shifted_by_a_quarter_of_a_pixel_is_understood(
    column: int, row: int, target: SailenvTarget, mug: Object3D
) -> None:
    """Every other pixel of a picture twice as large is a quarter of a pixel off the centres of the small picture's."""

    def ask(obj: Object3D, views: Sequence[View]) -> Image8:
        return target.render(obj, views, size=(2 * SIZE[0], 2 * SIZE[1]))[:, row::2, column::2]

    sampling, fidelity, usual = found(mug, AROUND, ask)
    assert sampling.shift == pytest.approx((column / 2 - 0.25, row / 2 - 0.25), abs=0.03)
    assert usual.mean()["correlation"] < 0.7
    assert fidelity.mean()["correlation"] >= 0.98
