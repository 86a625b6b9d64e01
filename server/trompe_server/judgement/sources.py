"""What the names in a judgement stand for: model files, networks and renderers, each with its hash or identity.

On one machine they are files and names (``LocalSources``), in a service stored things (``StoredSources``).
"""

import os
import re
from collections.abc import Callable, Sequence
from contextlib import AbstractContextManager, closing
from dataclasses import dataclass
from pathlib import Path
from typing import Final

from trompe_server.classifiers import Classifier, classifier_file, load_classifier
from trompe_server.formats import import_file
from trompe_server.job.protocol import Artifacts
from trompe_server.judging.judge import Judge
from trompe_server.library import Library
from trompe_server.library.catalogue import identity_of
from trompe_server.renderers import SailenvTarget, TargetRenderer, local_renderer
from trompe_server.renderers.local import COMMAND
from trompe_server.spec.labels import resolve_label
from trompe_shared.addresses import host_and_port
from trompe_shared.api import HashedFile, JudgedNetwork
from trompe_shared.engine import DEFAULT_ENGINE
from trompe_shared.errors import LabelError
from trompe_shared.local_files import CLASSIFIER_SUFFIXES, LOOKED_UP, classes_beside, model_file
from trompe_shared.object3d import Object3D, load_object, unpack
from trompe_shared.shipped import shipped_objects

_APART: Final = re.compile(rb"\n\x08location\x12([\x01-\x7f])")
"""In an .onnx file, before the name of another file with weights: its length (``TensorProto.external_data``)."""


@dataclass(frozen=True)
class JudgedObject:
    """An object and the file it comes from. shipped: its name if it is a shipped one."""

    obj: Object3D
    file: HashedFile
    shipped: str | None = None


@dataclass(frozen=True)
class LocalSources:
    """Paths and names on this machine, for a manifest in ``folder``. renderer: the default one."""

    folder: Path
    renderer: str = DEFAULT_ENGINE

    def object(self, source: str, role: str) -> JudgedObject:
        """The object ``before`` or ``after``, as ``role`` says. Raises ``ObjectError``."""
        if source in shipped_objects() and not Path(source).exists():
            return _shipped(source)
        name, content = model_file(Path(source))
        if isinstance(content, bytes):
            return _imported(content, name, source=self._relative(source), sha256=_hash_of_files(content))
        return _imported(content.read_bytes(), name, source=self._relative(source))

    def network(self, reference: str, label: Sequence[str | int]) -> tuple[Judge, JudgedNetwork]:
        """Load a network, with the labels among ``label`` that it knows.

        Raises ``ClassifierError``, and ``LabelError`` if it knows none of them.
        """
        path = network_file(reference)
        network = load_classifier(reference, classes=None if path is None else classes_beside(path))
        return _judge(network, label, reference, reference if path is None else self._relative(reference), path is None)

    def running(self, name: str) -> AbstractContextManager[TargetRenderer]:
        """The renderer at HOST:PORT, or a worker of our own with the engine ``name``. Raises ``RendererError``."""
        try:
            return closing(SailenvTarget(*host_and_port(name)))
        except ValueError:
            return local_renderer([*COMMAND, "--engine", name])

    def _relative(self, source: str) -> str:
        return Path(os.path.relpath(Path(source).resolve(), self.folder.resolve())).as_posix()


@dataclass(frozen=True)
class StoredSources:
    """Things in the library of a service.

    An uploaded model file is written to ``artifacts`` as ``before`` or ``after`` with its ending, so that a manifest
    beside them can be verified. renderer: the default one. opened: connects to the service's renderers of a name.
    """

    library: Library
    artifacts: Artifacts
    renderer: str
    opened: Callable[[str], AbstractContextManager[TargetRenderer]]
    device: str = "cpu"

    def object(self, source: str, role: str) -> JudgedObject:
        """As of ``LocalSources``; raises ``NotFoundError`` too."""
        original = self.library.original(source)
        if original is None:
            return _shipped(self.library.objects.find(source).name)
        data, filename = original
        if self.library.objects.find(source).id != identity_of(data):  # its textures were reduced
            data, filename = self.library.object_bytes(source), "object.zip"
        name = role + re.sub(r"[^a-z0-9.]", "", Path(filename).suffix.lower())
        self.artifacts.write(name, data)
        return _imported(data, filename, source=name)

    def network(self, reference: str, label: Sequence[str | int]) -> tuple[Judge, JudgedNetwork]:
        """As of ``LocalSources``."""
        info, file = self.library.classifier(reference), self.library.classifier_path(reference)
        network = load_classifier(file, name=info.name, classes=info.classes, device=self.device)
        by_name = network_file(file) is None
        shown = reference if by_name else f"{info.name}{Path(file).suffix}"
        return _judge(network, label, file, shown, by_name)

    def running(self, name: str) -> AbstractContextManager[TargetRenderer]:
        """The service's renderers called ``name`` for the block. Raises ``RendererError``."""
        return self.opened(name)


Sources = LocalSources | StoredSources
"""Resolves the names in a judgement."""


def network_file(reference: str) -> Path | None:
    """The file that ``reference`` names; ``None`` for a network by name."""
    is_file = reference.lower().endswith(CLASSIFIER_SUFFIXES) and not reference.startswith(LOOKED_UP)
    return Path(reference) if is_file else None


def _shipped(name: str) -> JudgedObject:
    data = shipped_objects()[name].read()
    return JudgedObject(load_object(data), HashedFile(source=name, sha256=identity_of(data), bytes=len(data)), name)


def _imported(data: bytes, name: str, *, source: str, sha256: str | None = None) -> JudgedObject:
    """The object in a model file called ``name``. Raises ``ObjectError``."""
    file = HashedFile(source=source, sha256=sha256 or identity_of(data), bytes=len(data))
    return JudgedObject(load_object(import_file(data, name=name).archive), file)


def _judge(
    network: Classifier, label: Sequence[str | int], file: str, reference: str, by_name: bool
) -> tuple[Judge, JudgedNetwork]:
    """A network in ``file`` (or by name) as a judge, and its record."""
    judge, names = Judge.of(network, known_labels(label, network)), network.classes
    return judge, JudgedNetwork(
        name=reference if by_name else network.name,
        reference=reference,
        sha256=_hash_of_network(classifier_file(file)),
        image_size=network.image_size,
        labels=list(judge.labels),
        label_names=None if names is None else [names[index] for index in judge.labels],
    )


def _hash_of_network(file: Path) -> str:
    """Hash of the file, and of those in which an .onnx keeps its weights."""
    data = file.read_bytes()
    found = _APART.finditer(data) if file.suffix.lower() == ".onnx" else ()
    names = {os.fsdecode(data[each.end() : each.end() + each[1][0]]) for each in found}
    apart = [path for name in sorted(names) if (path := file.parent / name).is_file()]
    return identity_of(b"".join([data, *(path.read_bytes() for path in apart)]))


def known_labels(label: Sequence[str | int], network: Classifier) -> tuple[int, ...]:
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


def _hash_of_files(data: bytes) -> str:
    """Hash of names and contents of the files in a zip that we packed: other packers pack other bytes."""
    return identity_of(
        "".join(f"{identity_of(content)} {name}\n" for name, content in sorted(unpack(data).items())).encode()
    )
