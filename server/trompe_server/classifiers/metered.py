"""Counts what a network is shown, and the seconds that it takes forth and back."""

import time
from typing import Any

from torch import Tensor, nn

from trompe_server.meter import Meter

__all__ = ["meter_network"]


def meter_network(network: nn.Module, meter: Meter) -> None:
    """Add to ``meter`` the images that ``network`` is shown from now on, and its seconds.

    On a GPU these are the seconds until the work was handed over, not until it was done.
    """
    began = 0.0

    def start(*_: Any) -> None:
        nonlocal began
        began = time.perf_counter()

    def stop(*_: Any) -> None:
        meter.add(classifier_seconds=time.perf_counter() - began)

    def done(_network: nn.Module, inputs: tuple[Tensor, ...], output: Tensor) -> None:
        stop()
        meter.add(classifier_images=len(inputs[0]))
        if output.requires_grad and inputs[0].requires_grad:
            output.register_hook(start)  # type: ignore[no-untyped-call]
            inputs[0].register_hook(stop)  # type: ignore[no-untyped-call]

    network.register_forward_pre_hook(start)
    network.register_forward_hook(done)
