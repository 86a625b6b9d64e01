"""A classifier without gradients."""

from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from numpy.typing import NDArray


class Scores:
    """A network seen through an .onnx file: scores, no gradients."""

    def __init__(self, inner: Any) -> None:
        self.inner: Any = inner
        self.name, self.classes = "net", inner.classes
        self.image_size, self.n_classes = inner.image_size, inner.n_classes

    def predict(self, images: NDArray[np.uint8]) -> NDArray[np.float32]:
        scores: NDArray[np.float32] = self.inner.predict(images)
        return scores

    def scores(self, images: Float[torch.Tensor, "n 3 H W"]) -> Float[torch.Tensor, "n classes"]:
        with torch.no_grad():
            logits: torch.Tensor = self.inner.logits(images)
        return logits
