"""Caches find models by content; a model that differs in its albedo alone is not parsed again."""

import gc
import threading
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from typing import Any
from unittest.mock import Mock

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tests.surfaces import with_alpha
from tests.wire import ORIGIN, boxes
from trompe_renderer.protocol import upload
from trompe_renderer.protocol.limits import Limits, StorageQuota
from trompe_renderer.protocol.session import Session
from trompe_renderer.protocol.upload import ModelCache
from trompe_renderer.world.model import HashedModel, content_key, model_of, repainted
from trompe_shared.engine import EngineInfo
from trompe_shared.errors import ObjectError, RendererError
from trompe_shared.local_files import pack_zip
from trompe_shared.object3d import Object3D, load_object, object_from_files

ENGINE = EngineInfo("test", "1")
HOLE = np.array([[0, 0, 255, 255]] * 4, np.uint8)
"""An alpha channel of half a side."""


def noise(seed: int, *shape: int) -> Any:
    return np.random.default_rng(seed).integers(0, 256, (*shape, 3), dtype=np.uint8)


def cache(**limits: int) -> ModelCache:
    return ModelCache(Limits(**limits))


def read(models: ModelCache, archive: bytes) -> HashedModel:
    return models.read(content_key(archive), archive)


@pytest.fixture
def parsed(monkeypatch: pytest.MonkeyPatch) -> Mock:
    """Is called for each object that is parsed."""
    counted = Mock(wraps=object_from_files)
    monkeypatch.setattr(upload, "object_from_files", counted)
    return counted


@settings(max_examples=20)
@given(st.dictionaries(st.sampled_from(["front", "back", "top"]), st.tuples(st.integers(1, 9), st.integers(1, 9))))
def test_however_it_comes_the_same_content_is_the_same_model(sizes: dict[str, tuple[int, int]]) -> None:
    box, models = boxes(), cache()
    textures = {f"{side}_albedo.png": noise(len(side), *size) for side, size in sizes.items()}
    archive = box.with_textures(textures).to_zip()
    whole = model_of(load_object(archive))
    first = read(models, box.to_zip())
    for model in (read(models, archive), repainted(first, textures)):
        assert model.key == whole.key
        assert model.shape == first.shape
        assert all((model.obj.textures[name] == whole.obj.textures[name]).all() for name in whole.obj.textures)
    assert (whole.key == first.key) == (not textures)


def test_an_archive_that_differs_in_an_albedo_alone_is_not_parsed_again(parsed: Mock) -> None:
    models, box = cache(), boxes()
    read(models, box.to_zip())
    read(models, box.with_textures({"front_albedo.png": noise(1, 8, 8)}).to_zip())
    with pytest.raises(ObjectError, match="front_albedo"):
        read(models, pack_zip({**box.files, "front_albedo.png": b"no picture"}))
    assert parsed.call_count == 1


def test_an_archive_that_differs_in_the_alpha_of_an_albedo_has_its_own() -> None:
    models, box = cache(), boxes()
    for archive in (box.to_zip(), with_alpha(box, "front_albedo.png", HOLE).to_zip(), box.to_zip()):
        assert read(models, archive).key == model_of(load_object(archive)).key


def test_alphas_are_decoded_once_however_often_an_object_is_painted(monkeypatch: pytest.MonkeyPatch) -> None:
    decoded = Mock(return_value=None)
    monkeypatch.setattr("trompe_renderer.world.model.opacity_of", decoded)
    model = model_of(boxes())
    keys = {repainted(model, {"front_albedo.png": noise(seed, 4, 4)}).key for seed in range(3)}
    assert len(keys) == 3
    assert decoded.call_count == len(model.obj.textures)


def test_any_other_difference_makes_another_shape() -> None:
    maps, models = {"normal": noise(1, 4, 4)}, cache()
    half = ((0.0, 0.0, 0.0), (0.1, 0.06, 0.05))
    objects = [boxes(maps=maps), boxes(half, maps=maps), boxes(maps={"normal": noise(2, 4, 4)}), boxes()]
    assert len({read(models, each.to_zip()).shape for each in objects}) == 4


def test_models_that_differ_in_their_alpha_alone_have_different_keys() -> None:
    pierced = [with_alpha(boxes(), "front_albedo.png", alpha) for alpha in (HOLE, HOLE[:, ::-1])]
    assert len({model_of(each).key for each in (boxes(), *pierced)}) == 3


@pytest.mark.parametrize(
    "textures",
    [
        pytest.param({"normal.png": noise(0, 4, 4)}, id="not an albedo"),
        pytest.param({"unheard of.png": noise(0, 4, 4)}, id="no such file"),
        pytest.param({"front_albedo.png": noise(0, 0, 4)}, id="no texels"),
    ],
)
def test_only_albedo_textures_with_texels_can_be_painted(textures: dict[str, Any]) -> None:
    with pytest.raises(ObjectError):
        repainted(model_of(boxes(maps={"normal": noise(1, 4, 4)})), textures)


def test_a_cache_forgets_the_model_used_longest_ago(parsed: Mock) -> None:
    models = cache(cached_models=3)
    archives = [boxes(((0, 0, 0), (0.1 + k / 100, 0.06, 0.04))).to_zip() for k in range(4)]
    for number, count in ((0, 1), (1, 2), (2, 3), (0, 3), (3, 4), (0, 4), (1, 5)):
        read(models, archives[number])
        assert parsed.call_count == count


def test_a_cache_keeps_the_last_models_within_a_number_of_bytes() -> None:
    archives = [boxes().with_textures({"front_albedo.png": noise(k, 64, 64)}).to_zip() for k in range(3)]
    size = read(cache(), archives[0]).nbytes
    models = cache(cached_size=2 * size + 2000)
    first, second, third = (read(models, archive) for archive in archives)
    assert read(models, archives[2]) is third
    assert read(models, archives[1]) is second
    assert read(models, archives[0]) is not first
    models = cache(cached_size=0)
    assert read(models, archives[1]) is read(models, archives[1])


def test_large_archives_are_parsed_one_after_the_other_and_small_ones_beside_them(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    box = boxes()
    small, *large = (box.with_textures({"front_albedo.png": noise(k, 60 * k, 60)}).to_zip() for k in (1, 8, 9))
    reading: list[int] = []
    most: list[int] = []
    both = threading.Event()

    def slowly(files: dict[str, bytes]) -> Object3D:
        reading.append(len(files))
        most.append(len(reading))
        both.set() if len(reading) == 2 else both.wait(0.2 if together == 1 else 120)
        reading.pop()
        return box

    monkeypatch.setattr(upload, "object_from_files", slowly)
    for archives, together in ((large, 1), ([small, large[0]], 2)):
        models = cache(large_archive=64 * 2**10)
        most.clear()
        both.clear()
        with ThreadPoolExecutor(2) as threads:
            list(threads.map(partial(read, models), archives))
        assert len(most) == 2
        assert max(most) == together


@given(st.lists(st.tuples(st.integers(0, 3), st.integers(0, 40)), max_size=30))
def test_holders_together_never_store_more_than_the_quota_and_may_always_store_less(
    wishes: list[tuple[int, int]],
) -> None:
    holders, held, quota = [Session(cache(), ENGINE) for _ in range(4)], [0] * 4, StorageQuota(100)
    for k, count in wishes:
        fits = sum(held) - held[k] + count <= 100
        try:
            quota.hold(holders[k], count)
            assert fits or count <= held[k]
            held[k] = count
        except RendererError:
            assert not fits
        assert sum(held) <= 100


def test_storage_is_limited_for_all_agents_together_and_free_when_they_leave() -> None:
    archive = boxes().to_zip()
    textures = sum(texture.nbytes for texture in boxes().textures.values())
    models = cache(uploads_total=2 * len(archive), textures_total=textures)
    one, other, third = (Session(models, ENGINE) for _ in range(3))
    (path,) = one.send_obj_zip(file=("box.zip", archive))
    one.send_obj_zip(file=("box.zip", archive))
    other.send_obj_zip(file=("box.zip", archive))
    with pytest.raises(RendererError, match="All agents together may store"):
        third.send_obj_zip(file=("box.zip", archive))
    one.spawn_object(name=f"file:{path}", **ORIGIN)
    with pytest.raises(RendererError, match="Try again after others have left"):
        other.spawn_object(name=f"file:{path}", **ORIGIN)
    one.despawn_object(instance=1)
    other.spawn_object(name=f"file:{path}", **ORIGIN)
    del one
    gc.collect()
    third.send_obj_zip(file=("box.zip", archive))
