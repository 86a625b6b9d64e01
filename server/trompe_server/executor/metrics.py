"""Prometheus counters of the work of attempts, in the process that dispatches them."""

from collections.abc import Mapping
from typing import Final

from prometheus_client import CollectorRegistry, Counter

Work = tuple[str, float, Mapping[str, int]]
"""A finished phase: its kind, its seconds, and ``PhaseReport.counts``."""

WORK: Final = CollectorRegistry()

_SECONDS: Final = Counter("trompe_phase_seconds", "Seconds spent in phases of jobs.", ["phase"], registry=WORK)
_COUNTERS: Final = {
    "attack_steps": Counter("trompe_attack_steps", "Attack steps.", registry=WORK),
    "classifier_images": Counter("trompe_classifier_images", "Images shown to classifiers by attacks.", registry=WORK),
    "target_renders": Counter("trompe_target_renders", "Images rendered by the target.", registry=WORK),
}


def count(work: Work) -> None:
    """Add a finished phase to the counters."""
    phase, seconds, amounts = work
    _SECONDS.labels(phase).inc(seconds)
    for name, amount in amounts.items():
        _COUNTERS[name].inc(amount)
