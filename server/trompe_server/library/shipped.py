"""The objects and the classifier of the package, as the library lists them."""

from functools import cache

from trompe_server.formats import facts_of
from trompe_server.library.catalogue import identity_of
from trompe_shared.api import ClassifierInfo, ObjectInfo
from trompe_shared.object3d import load_object
from trompe_shared.shipped import shipped_objects


@cache
def list_shipped_objects() -> list[ObjectInfo]:
    """The shipped objects. Reads them at the first call."""
    archives = {name: shipped.read() for name, shipped in shipped_objects().items()}
    return [
        ObjectInfo(id=identity_of(data), name=name, shipped=True, **facts_of(load_object(data)))
        for name, data in archives.items()
    ]


@cache
def list_shipped_classifiers() -> list[ClassifierInfo]:
    """The shipped classifier. A constant, because inspecting it takes a process that imports torch."""
    classes = sorted({shipped.label for shipped in shipped_objects().values()})
    tiny = ClassifierInfo(
        id="tiny",
        name="tiny",
        white_box=True,
        image_size=(128, 128),
        n_classes=len(classes),
        classes=classes,
        shipped=True,
    )
    return [tiny]
