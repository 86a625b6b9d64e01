"""From options to the job's objects: views, backgrounds, names, and refusals before any work."""

import io
from dataclasses import replace
from pathlib import Path
from typing import Any
from unittest.mock import Mock

import numpy as np
import pytest
from numpy.typing import NDArray
from PIL import Image

from tests.fakes import FakeTarget, Scores
from tests.job_runs import CHAIR, MemoryArtifacts, opened, setup_of, spec_of
from trompe_server.classifiers import load_classifier
from trompe_server.errors import NotFoundError
from trompe_server.library import Library
from trompe_server.renderers import BackdropTarget, SailenvTarget
from trompe_shared.errors import ClassifierError, LabelError, SpecError
from trompe_shared.geometry import Camera, View
from trompe_shared.object3d import Object3D, encode_png
from trompe_shared.shipped import shipped_objects

WOOD = "chair_wood_AlbedoTransparency.png"
Image8 = NDArray[np.uint8]


def test_a_shipped_object_has_its_own_framing(library: Library) -> None:
    setup = setup_of(library)
    assert (setup.object_name, setup.labels, setup.size) == ("chair", (3,), (128, 128))
    assert (len(setup.views), len(setup.held_out)) == (4, 3)
    assert {view.camera.distance for view in setup.views} == {shipped_objects()["chair"].distance}
    assert {view.camera.elevation for view in setup.views} == set(shipped_objects()["chair"].elevation)
    assert {view.background for view in setup.views} == {(255, 255, 255)}


def test_distance_and_elevation_are_options(library: Library) -> None:
    setup = setup_of(library, distance=2.5, elevation=(0.0, 0.0))
    assert {(view.camera.distance, view.camera.elevation) for view in setup.views} == {(2.5, 0)}


def test_an_uploaded_object_is_framed_by_its_size(tmp_path: Path, mug: Object3D) -> None:
    library = Library(tmp_path)
    library.add_object(io.BytesIO(mug.to_zip()), "cup.zip")
    setup = setup_of(library, object="cup", label="mug")
    assert {round(view.camera.distance / mug.radius, 3) for view in setup.views} == {2.1}
    assert {view.camera.elevation for view in setup.views} == {0, 50}


@pytest.mark.parametrize(
    ("background", "colour"), [("black", (0, 0, 0)), ("#0a64ff", (10, 100, 255)), ("#000000", (0, 0, 0))]
)
def test_a_background_can_be_a_colour(library: Library, background: str, colour: tuple[int, int, int]) -> None:
    setup = setup_of(library, background=[background])
    assert {view.background for view in (*setup.views, *setup.held_out)} == {colour}
    assert isinstance(setup.renderers[0].target, FakeTarget)


@pytest.mark.parametrize(
    ("options", "error", "message"),
    [
        pytest.param({"object": "sofa"}, NotFoundError, "sofa.*chair", id="object"),
        pytest.param({"classifier": "resnet"}, NotFoundError, "resnet.*tiny", id="classifier"),
        pytest.param({"judges": ["resnet"]}, NotFoundError, "resnet", id="judge"),
        pytest.param({"label": "chairs"}, LabelError, "did you mean 'chair'", id="label"),
        pytest.param({"keep": 9e-7}, SpecError, r"`keep: 9e-07` .* 32768 texels .* keep 3e-05 or more", id="keep"),
        pytest.param({"queries": 4}, SpecError, "'tiny' gives them: leave it out", id="queries"),
        *(
            pytest.param({"background": [name]}, NotFoundError, "background", id=f"background {name!r}")
            for name in ("#xyzxyz", "#12 34 ", "#123", "red", "")
        ),
    ],
)
def test_unknown_names_and_unfit_options_are_refused_before_any_work(
    library: Library, options: dict[str, Any], error: type[Exception], message: str
) -> None:
    with pytest.raises(error, match=message):
        setup_of(library, **options)


def test_masks_of_another_size_or_without_a_texel_are_refused(library: Library) -> None:
    size = CHAIR.textures[WOOD].shape
    small, white = (
        library.add_background(encode_png(np.full(shape, 255, np.uint8)), "mask.png").id for shape in ((8, 8, 3), size)
    )
    with pytest.raises(SpecError, match=r"8 x 8 pixels, the texture 128 x 128"):
        setup_of(library, masks={WOOD: small})
    with pytest.raises(SpecError, match=r"leave no texel of \['chair_cushion'\]: paint white"):
        setup_of(library, masks={WOOD: white}, materials=["chair_cushion"])


def test_an_unavailable_device_is_refused(library: Library) -> None:
    with pytest.raises(ClassifierError, match="'cuda:7'"):
        opened(spec_of(), library, MemoryArtifacts(), device="cuda:7")


# Classifiers without gradients


@pytest.fixture
def scores_only(monkeypatch: pytest.MonkeyPatch) -> None:
    """The classifier "net" gives scores alone."""
    monkeypatch.setattr(
        "trompe_server.job.setup._stored_classifier",
        lambda name, **_: Scores(load_classifier("tiny")) if name == "net" else load_classifier("tiny"),
    )


@pytest.mark.usefixtures("scores_only")
@pytest.mark.parametrize(
    ("options", "error", "message"),
    [
        ({"classifier": "net"}, SpecError, r"'net'.*no gradients.*\.onnx.*\.pt2.*`judges`.*`queries: 10`"),
        ({"classifier": "net", "queries": 6, "tau": 0.1}, SpecError, "need gradients, and 'net' gives none"),
        ({"classifier": "net", "queries": 6, "keep": 0.1}, SpecError, "need gradients, and 'net' gives none"),
        ({"ensemble": ["net"]}, ClassifierError, "'net' gives scores but no gradients.*ensemble"),
    ],
    ids=str,
)
def test_a_classifier_without_gradients_is_refused_for_all_that_needs_them(
    library: Library, options: dict[str, Any], error: type[Exception], message: str
) -> None:
    with pytest.raises(error, match=message):
        setup_of(library, **options)


# A photograph behind the object


def test_an_uploaded_photograph_stands_behind_the_object(library: Library, photo: Image8) -> None:
    info = library.add_background(encode_png(photo), "wall.png")
    setup = setup_of(library, background=[info.id])
    target = setup.renderers[0].target
    image = target.render(setup.obj, setup.views[:1], size=setup.size)[0]
    assert isinstance(target, BackdropTarget)
    black = replace(setup.views[0], background=(0, 0, 0))
    plain = FakeTarget().render(setup.obj, [black], size=setup.size)[0]
    there = (plain != 0).any(axis=-1)
    assert (image[there] == plain[there]).all()
    assert len(np.unique(image[~there], axis=0)) > 50


def test_a_photograph_is_composited_as_by_hand(mug: Object3D, photo: Image8) -> None:
    views, size = [View(Camera(0.157, 30, 20), backdrop="photo"), View(Camera(0.3, 90, 0), backdrop="photo")], (40, 60)
    on_frame = Mock()
    images = BackdropTarget(FakeTarget(), {"photo": photo}).render(mug, views, size=size, on_frame=on_frame)
    cropped = Image.fromarray(photo[25:65]).resize((60, 40), Image.Resampling.LANCZOS)
    for image, view in zip(images, views, strict=True):
        plain = [replace(view, background=colour) for colour in ((0, 0, 0), (255, 255, 255))]
        black, white = FakeTarget().render(mug, plain, size=size)
        free = (black == 0).all(axis=-1) & (white == 255).all(axis=-1)
        expected = np.where(free[..., None], np.asarray(cropped), black)
        assert np.abs(image.astype(int) - expected).max() <= 1
        assert 0.1 < free.mean() < 0.97
    assert on_frame.call_count == len(views)


def test_a_plain_photograph_is_as_a_uniform_background_at_soft_edges_too(mug: Object3D, target: SailenvTarget) -> None:
    view, size = View(Camera(0.157, 30, 20), background=(120, 60, 200)), (64, 64)
    picture = np.full((5, 5, 3), view.background, np.uint8)
    pictured = [replace(view, backdrop="plain"), view]
    composed = BackdropTarget(target, {"plain": picture}).render(mug, pictured, size=size)
    assert np.abs(composed[0].astype(int) - composed[1]).max() <= 2
    assert (composed[1] == target.render(mug, [view], size=size)).all()


def test_views_draw_their_backgrounds_from_several(library: Library, photo: Image8) -> None:
    picture = library.add_background(encode_png(photo), "wall.png").id
    options: dict[str, Any] = {"background": ["black", "#ff0000", picture], "held_out": 30}
    setup = setup_of(library, **options)
    for views in (setup.views, setup.held_out):
        seen = {view.backdrop or view.background for view in views}
        assert seen <= {(0, 0, 0), (255, 0, 0), picture}
    assert len({view.backdrop or view.background for view in setup.held_out}) == 3
    assert setup.backdrops[picture].shape == (*setup.size, 3)
    target = setup.renderers[0].target
    assert isinstance(target, BackdropTarget)
    assert target._pictures is setup.backdrops  # each is scaled once
    assert setup_of(library, **options).views == setup.views


def test_the_attack_knows_the_backgrounds_of_its_views(library: Library, photo: Image8) -> None:
    picture = library.add_background(encode_png(photo), "wall.png").id
    setup = setup_of(library, background=["black", "#ff0000", picture], pool=30)
    backgrounds = setup.backgrounds(setup.views)
    assert backgrounds is not None
    for view, number in zip(setup.views, backgrounds.own, strict=True):
        expected = setup.backdrops[picture] if view.backdrop else np.array(view.background, np.uint8)
        assert (backgrounds.pictures[number].numpy() == expected).all()
    black = setup_of(library, background=["black"], pool=30)
    assert black.backgrounds(black.views) is None
