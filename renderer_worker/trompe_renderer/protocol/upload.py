"""Uploaded archives, parsed once: the same archive again costs no more than its hash.

An archive that differs from a recent one in its albedo textures alone, as in an attack, costs no more than decoding the
new textures.
"""

import threading
from collections import OrderedDict
from collections.abc import Mapping
from contextlib import AbstractContextManager, nullcontext
from dataclasses import replace

from trompe_renderer.protocol.limits import Limits, StorageQuota
from trompe_renderer.world.model import HashedModel, model_of, opacities_of, repainted
from trompe_shared.object3d import decode_rgb, object_from_files, unpacked_size, unzip


class ModelCache:
    """The models read last, shared by all agents, and the agents' storage quotas."""

    def __init__(self, limits: Limits) -> None:
        self.limits = limits
        self.uploads, self.textures = StorageQuota(limits.uploads_total), StorageQuota(limits.textures_total)
        self._models: OrderedDict[str, HashedModel] = OrderedDict()
        self._lock = threading.Lock()
        self._large_lock = threading.Lock()

    def read(self, key: str, archive: bytes) -> HashedModel:
        """The model in a zip with the hash ``key`` (``content_key``). Raises ``ObjectError``.

        Agents do not wait for each other, except with large archives. So two agents that send the same object at the
        same time both parse it.
        """
        with self._lock:
            found, recent = self._models.get(key), list(self._models.values())
        if found is None:
            with self._turn(archive):
                found = _read(unzip(archive), recent)
        with self._lock:
            self._models[key] = found
            self._models.move_to_end(key)
            while len(self._models) > 1 and self._full():
                self._models.popitem(last=False)
        return found

    def _turn(self, archive: bytes) -> AbstractContextManager[object]:
        return self._large_lock if unpacked_size(archive) > self.limits.large_archive else nullcontext()

    def _full(self) -> bool:
        size = sum(model.nbytes for model in self._models.values())
        return len(self._models) > self.limits.cached_models or size > self.limits.cached_size


def _read(files: Mapping[str, bytes], recent: list[HashedModel]) -> HashedModel:
    for model in () if _may_blend(files) else reversed(recent):
        if _only_albedos_differ(files, model):
            changed = [name for name in model.albedos if files[name] != model.obj.files[name]]
            new = repainted(model, {name: decode_rgb(files[name], name) for name in changed})
            obj = replace(new.obj, files=files)
            return replace(new, obj=obj, opacities={**new.opacities, **opacities_of(obj, changed)})
    return model_of(object_from_files(files))


def _may_blend(files: Mapping[str, bytes]) -> bool:
    """Whether the alpha of albedos decides which materials are blended."""
    tables = (data for name, data in files.items() if name.lower().endswith(("_mat_def.json", ".mtl")))
    return any(b"opacity" in data or b"map_d" in data for data in tables)


def _only_albedos_differ(files: Mapping[str, bytes], model: HashedModel) -> bool:
    before = model.obj.files
    return files.keys() == before.keys() and all(files[n] == before[n] for n in files if n not in model.albedos)
