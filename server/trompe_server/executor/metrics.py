"""Prometheus counters of a worker.

Workers of this machine write them to files in the folder ``PROMETHEUS_MULTIPROC_DIR``, which the API or
``trompe worker`` sums up. Those of Ray nodes stay there.
"""

from collections.abc import Mapping
from typing import Final

from prometheus_client import Counter

PHASE_SECONDS: Final = Counter("trompe_phase_seconds", "Seconds spent in phases of jobs.", ["phase"])
COUNTERS: Final = {
    "attack_steps": Counter("trompe_attack_steps", "Attack steps."),
    "classifier_images": Counter("trompe_classifier_images", "Images shown to classifiers by attacks."),
    "target_renders": Counter("trompe_target_renders", "Images rendered by the target."),
}


def count_phase(phase: str, seconds: float, counts: Mapping[str, int]) -> None:
    """Count a phase that ran, such as ``attack-003``, under its kind (``attack``), and its ``PhaseReport.counts``."""
    PHASE_SECONDS.labels(phase.partition("-")[0]).inc(seconds)
    for name, amount in counts.items():
        COUNTERS[name].inc(amount)
