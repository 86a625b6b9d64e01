"""torchvision beside a torch that it was not built for."""

import importlib
from typing import Any

import pytest
import torch


def import_torchvision() -> Any:
    """torchvision's networks. Where torchvision was built for another torch its compiled operators are missing; no
    classification network uses one, so names for those that it looks for while it is imported are enough."""
    try:
        return importlib.import_module("torchvision.models")
    except ImportError:
        pytest.skip("torchvision is not installed")
    except RuntimeError:
        for name in ("nms", "qnms"):
            schema = "(Tensor dets, Tensor scores, float iou_threshold) -> Tensor"
            torch.library.define(f"torchvision::{name}", schema)
        return importlib.import_module("torchvision.models")
