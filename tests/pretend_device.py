"""A device that computes on the CPU, to the same bits, but holds its own tensors.

Like a graphics card it refuses tensors of other devices, so a tensor on the wrong device is an error on any machine.
"""

from collections.abc import Callable
from functools import cache
from types import SimpleNamespace
from typing import Any, Final

import pytest
import torch
from torch import Tensor
from torch.library import Library
from torch.utils import backend_registration
from torch.utils._python_dispatch import return_and_correct_aliasing
from torch.utils._pytree import tree_leaves, tree_map_only

NAME: Final = "pretend"

AWAY_ALLOWED: Final = {"aten::copy_", "aten::_to_copy"}
"""Operators that move tensors between devices."""

INDEXING: Final = {"aten::index", "aten::index_put", "aten::index_put_", "aten::_index_put_impl_"}
"""Operators to which a graphics card accepts indices on the CPU, but not the other way round."""

PRODUCTS: Final = {"aten::mm", "aten::mv", "aten::bmm", "aten::dot"}
"""Operators that a graphics card has not for whole numbers."""

MADE_BY_HAND: Final = ("tensor", "arange", "linspace")
"""Functions that write into memory before any operator reaches the device."""


class PretendTensor(Tensor):
    """A tensor on the device; ``held`` is its copy on the CPU."""

    held: Tensor

    @staticmethod
    def __new__(cls, held: Tensor) -> "PretendTensor":
        made: PretendTensor = torch.Tensor._make_wrapper_subclass(
            cls,
            held.size(),
            strides=held.stride(),
            storage_offset=held.storage_offset(),
            dtype=held.dtype,
            device=torch.device(NAME, 0),
        )
        made.held = held
        return made

    @classmethod
    def __torch_dispatch__(cls, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:  # type: ignore[override]
        return _compute(func, args, kwargs or {})

    def tolist(self) -> Any:
        """Torch refuses it for wrapper tensors."""
        return self.held.tolist()

    def __getitem__(self, key: Any) -> Tensor:
        """Torch would make tensors of lists of numbers without the device."""
        keys = key if isinstance(key, tuple) else (key,)
        return super().__getitem__(tuple(torch.tensor(each) if isinstance(each, list) else each for each in keys))


def _compute(func: Any, args: Any, kwargs: Any) -> Any:
    tensors = [each for each in tree_leaves((args, kwargs)) if isinstance(each, Tensor)]
    here = [each for each in tensors if isinstance(each, PretendTensor)]
    _check_together(func.name().split(".")[0], tensors, bool(here))
    if func.name().split(".")[0] in PRODUCTS and here and not here[0].is_floating_point():
        raise RuntimeError(f"{func.name()}: not implemented for {here[0].dtype}")
    device = kwargs.get("device")
    stays = bool(here) if device is None else torch.device(device).type == NAME
    if func is torch.ops.aten.copy_.default:
        stays = isinstance(args[0], PretendTensor)
    plain_args, plain = tree_map_only(PretendTensor, lambda each: each.held, (args, kwargs))
    found = func(*plain_args, **plain | ({} if device is None else {"device": torch.device("cpu")}))
    if stays:
        moved = tree_map_only(Tensor, PretendTensor, found)
        return return_and_correct_aliasing(func, args, kwargs, moved)  # type: ignore[no-untyped-call]
    return args[0] if func is torch.ops.aten.copy_.default else found


def _check_together(name: str, tensors: list[Tensor], some_here: bool) -> None:
    """Raise as a graphics card would; tensors without dimensions may come from the CPU."""
    away = any(each.ndim and not isinstance(each, PretendTensor) for each in tensors)
    indexing = name in INDEXING and isinstance(tensors[0], PretendTensor)
    if some_here and away and name not in AWAY_ALLOWED and not indexing:
        raise RuntimeError(f"{name}: tensors on several devices: {[(str(t.device), tuple(t.shape)) for t in tensors]}")


MODULE: Final = SimpleNamespace(
    is_initialized=lambda: True,
    is_available=lambda: True,
    current_device=lambda: 0,
    device_count=lambda: 1,
    _is_in_bad_fork=lambda: False,
    manual_seed_all=lambda seed: None,
    get_rng_state=lambda device=None: torch.empty(0, dtype=torch.uint8),
    set_rng_state=lambda state, device=None: None,
)
"""The device's module, as torch expects it; its random state is empty."""

POSSIBLE: Final = (
    hasattr(backend_registration, "_setup_privateuseone_for_python_backend") and not torch.cuda.is_available()
)
"""Older versions of torch have no devices written in Python; beside a graphics card torch takes gradients on one kind
of device alone."""


@cache
def register() -> Library | None:
    """Register the device. Call before the first gradient of the process, when torch counts its devices."""
    if not POSSIBLE:
        return None
    backend_registration._setup_privateuseone_for_python_backend(NAME, backend_module=MODULE)
    library = Library("_", "IMPL")  # type: ignore[no-untyped-call]
    library.fallback(lambda func, *args, **kwargs: _compute(func, args, kwargs), "PrivateUse1")  # type: ignore[no-untyped-call]
    return library


def _then_moved(make: Callable[..., Tensor]) -> Callable[..., Tensor]:
    def made(*args: Any, device: Any = None, **kwargs: Any) -> Tensor:
        return make(*args, **kwargs) if device is None else make(*args, **kwargs).to(device)

    return made


def pretend_device(monkeypatch: pytest.MonkeyPatch) -> str:
    """Name of the device for one test. Skips the test if this torch cannot have one."""
    if register() is None:
        pytest.skip("no device written in Python: this torch is older, or has a graphics card")
    for name in MADE_BY_HAND:
        monkeypatch.setattr(torch, name, _then_moved(getattr(torch, name)))
    return NAME
