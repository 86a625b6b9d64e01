"""A network as a judge: the classes that count as the object for it, and its verdicts on images."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Self

import numpy as np
from numpy.typing import NDArray
from scipy.special import softmax

from trompe_server.classifiers import Classifier
from trompe_server.judging.metrics import Logits, accuracy
from trompe_server.pictures import Verdict
from trompe_server.spec.labels import resolve_labels
from trompe_server.spec.neighbours import neighbours
from trompe_shared.api import Accuracy


@dataclass(frozen=True)
class Judge:
    """labels: the object's classes. near: their neighbours; ``None`` without class names of the network's own."""

    network: Classifier
    labels: tuple[int, ...]
    near: frozenset[int] | None

    @classmethod
    def of(
        cls, network: Classifier, label: str | int | Sequence[str | int], *, classes: Sequence[str] | None = None
    ) -> Self:
        """``classes``: names for a network without its own. Raises ``LabelError`` and ``SpecError``."""
        names = network.classes
        labels = resolve_labels(label, names or classes, network.n_classes, network.name)
        return cls(network, labels, None if names is None else neighbours(labels, names))

    def accuracy(self, before: Logits, after: Logits | None, *, distinct: int | None = None) -> Accuracy:
        """Accuracy from logits (views, classes) of the same views; arguments as ``metrics.accuracy``."""
        return accuracy(before, after, self.labels, near=self.near, distinct=distinct)

    def class_name(self, index: int) -> str:
        """Name of a class, or its number if the network has no names."""
        classes = self.network.classes
        return classes[index] if classes is not None else f"class {index}"

    def verdicts(self, logits: NDArray[np.float32]) -> list[Verdict]:
        """Predictions in words, one for each row of logits (views, classes)."""
        best, probability = logits.argmax(axis=1), softmax(logits.astype(np.float64), axis=-1).max(axis=1)
        return [
            Verdict(self.class_name(int(index)), float(share), index in self.labels)
            for index, share in zip(best, probability, strict=True)
        ]
