"""Inspection of classifiers in a process of its own: this one stays free of torch and safe from the file."""

from collections.abc import Callable, Sequence
from functools import cache
from typing import Final

from trompe_server.system.sandbox import run_limited
from trompe_shared.api import ClassifierInfo
from trompe_shared.errors import ClassifierError

_SECONDS: Final = 300.0
_MEMORY: Final = 8 * 2**30
"""Bytes of address space; networks for ImageNet take less than half."""

Inspect = Callable[[str], dict[str, object]]
"""Maps a file or a name to the fields of ``ClassifierInfo`` that depend on the network."""


def inspect_classifier(path_or_name: str) -> dict[str, object]:
    """Load a classifier in a child process and describe it. Raises ``ClassifierError``."""
    module = "trompe_server.classifiers.inspect"
    return dict(run_limited(module, [path_or_name], memory=_MEMORY, seconds=_SECONDS, failure=ClassifierError))


@cache
def named_classifier(reference: str, inspect: Inspect) -> ClassifierInfo:
    """A network by name, such as ``timm:NAME``. Raises ``ClassifierError`` if it cannot be loaded."""
    name = reference.partition(":")[2]
    return ClassifierInfo.model_validate(inspect(reference) | {"id": reference, "name": name})


def check_classes(classes: Sequence[str] | None, n_classes: object) -> None:
    """Raise ``ClassifierError`` unless there is one name per class."""
    if classes is not None and len(classes) != n_classes:
        raise ClassifierError(
            f"{len(classes)} class names for a classifier of {n_classes} classes: send one name per logit, in order."
        )
