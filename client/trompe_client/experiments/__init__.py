"""Experiments: a grid of jobs from a readable file, run with one command, resumable, kept as CSV.

Reading order: ``design`` (the file), ``plan`` (its jobs), ``service`` (the server as an experiment needs it), ``run``
(one after the other until all are there), ``tables`` (what came out, for people).
"""

from trompe_client.experiments.design import Experiment, load_experiment, shipped_experiments
from trompe_client.experiments.plan import Plan, Row, plan_experiment
from trompe_client.experiments.run import Outcome, run_experiment
from trompe_client.experiments.service import ClientService, Service

__all__ = [
    "ClientService",
    "Experiment",
    "Outcome",
    "Plan",
    "Row",
    "Service",
    "load_experiment",
    "plan_experiment",
    "run_experiment",
    "shipped_experiments",
]
