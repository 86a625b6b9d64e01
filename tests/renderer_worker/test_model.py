"""Objects are found again by their content, and one that differs in its albedo alone is not read anew."""

import gc
import threading
import time
from collections.abc import Callable

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from trompe_renderer import model as model_module
from trompe_renderer.model import Holdings, Library, content_key, model_of, repainted
from trompe_renderer.session import Session
from trompe_shared.errors import ObjectError, RendererError
from trompe_shared.object3d import Object3D, load_object, pack_zip

Boxes = Callable[..., Object3D]


def noise(seed: int, *shape: int) -> np.ndarray:
    return np.random.default_rng(seed).integers(0, 256, (*shape, 3), dtype=np.uint8)


def read(library: Library, archive: bytes) -> model_module.Model:
    return library.read(content_key(archive), archive)


@settings(max_examples=20, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(st.dictionaries(st.sampled_from(["front", "back", "top"]), st.tuples(st.integers(1, 9), st.integers(1, 9))))
def test_however_it_comes_the_same_content_is_the_same_model(
    make_boxes: Boxes, sizes: dict[str, tuple[int, int]]
) -> None:
    box, library = make_boxes(), Library()
    textures = {f"{side}_albedo.png": noise(len(side), *size) for side, size in sizes.items()}
    archive = box.with_textures(textures).to_zip()
    whole = model_of(load_object(archive))
    first = read(library, box.to_zip())
    for model in (read(library, archive), repainted(first, textures)):
        assert model.key == whole.key
        assert model.shape == first.shape
        assert all((model.obj.textures[name] == whole.obj.textures[name]).all() for name in whole.obj.textures)
    assert (whole.key == first.key) == (not textures)


def test_an_archive_that_differs_in_an_albedo_alone_is_not_parsed_again(
    make_boxes: Boxes, monkeypatch: pytest.MonkeyPatch
) -> None:
    library, box = Library(), make_boxes()
    read(library, box.to_zip())
    monkeypatch.setattr(model_module, "object_from_files", lambda files: pytest.fail("parsed again"))
    read(library, box.with_textures({"front_albedo.png": noise(1, 8, 8)}).to_zip())
    with pytest.raises(ObjectError, match="front_albedo"):
        read(library, pack_zip({**box.files, "front_albedo.png": b"no picture"}))


def test_any_other_difference_makes_another_shape(make_boxes: Boxes) -> None:
    box = make_boxes(maps={"normal": noise(1, 4, 4)})
    others = [
        make_boxes(((0, 0, 0), (0.1, 0.06, 0.05)), maps={"normal": noise(1, 4, 4)}),
        make_boxes(maps={"normal": noise(2, 4, 4)}),
        make_boxes(),
    ]
    library = Library()
    shapes = [read(library, each.to_zip()).shape for each in (box, *others)]
    assert len(set(shapes)) == 4


@pytest.mark.parametrize(
    "textures",
    [
        pytest.param({"normal.png": noise(0, 4, 4)}, id="not an albedo"),
        pytest.param({"unheard of.png": noise(0, 4, 4)}, id="no such file"),
        pytest.param({"front_albedo.png": noise(0, 0, 4)}, id="no texels"),
    ],
)
def test_what_cannot_be_painted_is_refused(make_boxes: Boxes, textures: dict[str, np.ndarray]) -> None:
    with pytest.raises(ObjectError):
        repainted(model_of(make_boxes(maps={"normal": noise(1, 4, 4)})), textures)


def test_a_library_forgets_what_was_used_longest_ago(make_boxes: Boxes, monkeypatch: pytest.MonkeyPatch) -> None:
    library, read_from_scratch = Library(), []
    original = model_module.object_from_files
    monkeypatch.setattr(model_module, "object_from_files", lambda f: read_from_scratch.append(1) or original(f))
    archives = [make_boxes(((0, 0, 0), (0.1 + k / 100, 0.06, 0.04))).to_zip() for k in range(model_module.CAPACITY + 1)]
    for archive in archives[:-1]:
        read(library, archive)
    read(library, archives[0])
    assert len(read_from_scratch) == model_module.CAPACITY
    read(library, archives[-1])
    read(library, archives[0])
    assert len(read_from_scratch) == model_module.CAPACITY + 1
    read(library, archives[1])
    assert len(read_from_scratch) == model_module.CAPACITY + 2


def test_large_archives_are_read_one_after_the_other_and_small_ones_beside_them(
    make_boxes: Boxes, monkeypatch: pytest.MonkeyPatch
) -> None:
    box = make_boxes()
    small, *large = (box.with_textures({"front_albedo.png": noise(k, 60 * k, 60)}).to_zip() for k in (1, 8, 9))
    monkeypatch.setattr(model_module, "LARGE", 64 * 2**10)
    reading: list[int] = []
    most: list[int] = []

    def slowly(files: dict[str, bytes]) -> Object3D:
        reading.append(len(files))
        most.append(len(reading))
        time.sleep(0.2)
        reading.pop()
        return box

    monkeypatch.setattr(model_module, "object_from_files", slowly)
    for archives, together in ((large, 1), ([small, large[0]], 2)):
        library = Library()
        most.clear()
        threads = [threading.Thread(target=read, args=(library, archive)) for archive in archives]
        for thread in threads:
            thread.start()
        for thread in threads:
            thread.join()
        assert len(most) == 2
        assert max(most) == together


def test_a_library_keeps_the_last_models_within_a_number_of_bytes(
    make_boxes: Boxes, monkeypatch: pytest.MonkeyPatch
) -> None:
    library = Library()
    archives = [make_boxes().with_textures({"front_albedo.png": noise(k, 64, 64)}).to_zip() for k in range(3)]
    first = read(library, archives[0])
    monkeypatch.setattr(model_module, "KEPT_BYTES", 2 * first.nbytes + 2000)
    second, third = (read(library, archive) for archive in archives[1:])
    assert read(library, archives[2]) is third
    assert read(library, archives[1]) is second
    assert read(library, archives[0]) is not first
    monkeypatch.setattr(model_module, "KEPT_BYTES", 0)
    assert read(library, archives[1]) is read(library, archives[1])


@given(st.lists(st.tuples(st.integers(0, 3), st.integers(0, 40)), max_size=30))
def test_holders_together_never_keep_more_than_there_is_and_may_always_keep_less(wishes: list[tuple[int, int]]) -> None:
    holders, held, holdings = [Session(Library()) for _ in range(4)], [0] * 4, Holdings(100)
    for k, count in wishes:
        fits = sum(held) - held[k] + count <= 100
        try:
            holdings.hold(holders[k], count)
            assert fits or count <= held[k]
            held[k] = count
        except RendererError:
            assert not fits
        assert sum(held) <= 100


def test_what_agents_keep_is_limited_for_all_together_and_free_when_they_leave(make_boxes: Boxes) -> None:
    archive = make_boxes().to_zip()
    textures = sum(texture.nbytes for texture in make_boxes().textures.values())
    library = Library(uploads=2 * len(archive), textures=textures)
    place = {"position": (0.0, 0.0, 0.0), "rotation": (0.0, 0.0, 0.0), "scale": (1.0, 1.0, 1.0)}
    one, other, third = (Session(library) for _ in range(3))
    (path,) = one.send_obj_zip(file=("box.zip", archive))
    one.send_obj_zip(file=("box.zip", archive))
    other.send_obj_zip(file=("box.zip", archive))
    with pytest.raises(RendererError, match="All agents together keep up to"):
        third.send_obj_zip(file=("box.zip", archive))
    one.spawn_object(name=f"file:{path}", **place)
    with pytest.raises(RendererError, match="Try again when others have left"):
        other.spawn_object(name=f"file:{path}", **place)
    one.despawn_object(instance=1)
    other.spawn_object(name=f"file:{path}", **place)
    del one
    gc.collect()
    third.send_obj_zip(file=("box.zip", archive))
