"""Experiments: a grid of jobs from a file, run with one command, resumable, kept as CSV.

Reading order: ``design`` (the file), ``plan`` (its jobs), ``service`` (the server), ``run`` (the runner), ``table``
(its results), ``figures``.
"""

from trompe_experiments.design import Experiment, load_experiment, shipped_experiments
from trompe_experiments.plan import Plan, Row, plan_experiment
from trompe_experiments.run import run_experiment
from trompe_experiments.service import Service

__all__ = [
    "Experiment",
    "Plan",
    "Row",
    "Service",
    "load_experiment",
    "plan_experiment",
    "run_experiment",
    "shipped_experiments",
]
