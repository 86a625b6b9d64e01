"""Model files, networks and renderers of a judgement, each with its hash or identity."""

import contextlib
import os
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

from trompe_server.classifiers import Classifier, classifier_file, load_classifier
from trompe_server.formats import import_file
from trompe_server.judging.judge import Judge
from trompe_server.library.intake import identity_of
from trompe_server.renderers import SailenvTarget, TargetRenderer, local_renderer
from trompe_server.renderers.local import COMMAND
from trompe_server.spec.labels import resolve_label
from trompe_shared.api import HashedFile, JudgedNetwork
from trompe_shared.errors import LabelError
from trompe_shared.local_files import CLASSIFIER_SUFFIXES, LOOKED_UP, classes_beside, model_file
from trompe_shared.object3d import Object3D, load_object, unpack
from trompe_shared.shipped import shipped_objects

__all__ = ["JudgedObject", "network_file", "open_judge", "read_judged", "running"]


@dataclass(frozen=True)
class JudgedObject:
    """An object and the file it comes from. shipped: its name if it is a shipped one."""

    obj: Object3D
    file: HashedFile
    shipped: str | None = None


def read_judged(source: str, folder: Path) -> JudgedObject:
    """Read a model file, or a shipped object by name, for a manifest in ``folder``. Raises ``ObjectError``."""
    if source in shipped_objects() and not Path(source).exists():
        data = shipped_objects()[source].read()
        return JudgedObject(
            load_object(data), HashedFile(source=source, sha256=identity_of(data), bytes=len(data)), source
        )
    name, content = model_file(Path(source))
    data = content if isinstance(content, bytes) else content.read_bytes()
    sha256 = _hash_of_files(data) if isinstance(content, bytes) else identity_of(data)
    file = HashedFile(source=_relative(source, folder), sha256=sha256, bytes=len(data))
    return JudgedObject(load_object(import_file(data, name=name).archive), file)


def open_judge(reference: str, label: Sequence[str | int], folder: Path) -> tuple[Judge, JudgedNetwork]:
    """Load a network, with the labels among ``label`` that it knows.

    Raises ``ClassifierError``, and ``LabelError`` if it knows none of them.
    """
    path = network_file(reference)
    network = load_classifier(reference, classes=None if path is None else classes_beside(path))
    judge = Judge.of(network, _known(label, network))
    names = network.classes
    return judge, JudgedNetwork(
        name=reference if path is None else network.name,
        reference=reference if path is None else _relative(reference, folder),
        sha256=identity_of(classifier_file(reference).read_bytes()),
        image_size=network.image_size,
        labels=list(judge.labels),
        label_names=None if names is None else [names[index] for index in judge.labels],
    )


def network_file(reference: str) -> Path | None:
    """The file that ``reference`` names; ``None`` for a network by name."""
    is_file = reference.endswith(CLASSIFIER_SUFFIXES) and not reference.startswith(LOOKED_UP)
    return Path(reference) if is_file else None


@contextlib.contextmanager
def running(name: str) -> Iterator[TargetRenderer]:
    """The renderer at HOST:PORT, or a worker of our own with the engine ``name`` for the block.

    Raises ``RendererError``.
    """
    host, _, port = name.rpartition(":")
    if host and port.isdecimal():
        with contextlib.closing(SailenvTarget(host, int(port))) as target:
            yield target
        return
    with local_renderer([*COMMAND, "--engine", name]) as target:
        yield target


def _known(label: Sequence[str | int], network: Classifier) -> tuple[int, ...]:
    """The classes that ``label`` names in the network's words. Raises ``LabelError`` if it names none."""
    found, unknown = dict[int, None](), list[LabelError]()
    for each in label:
        try:
            found[resolve_label(each, network.classes, network.n_classes, network.name)] = None
        except LabelError as error:
            unknown.append(error)
    if not found:
        raise unknown[0]
    return tuple(found)


def _relative(source: str, folder: Path) -> str:
    return Path(os.path.relpath(Path(source).resolve(), folder.resolve())).as_posix()


def _hash_of_files(data: bytes) -> str:
    """Hash of names and contents of the files in a zip that we packed: other packers pack other bytes."""
    return identity_of(
        "".join(f"{identity_of(content)} {name}\n" for name, content in sorted(unpack(data).items())).encode()
    )
