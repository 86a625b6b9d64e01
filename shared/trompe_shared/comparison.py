"""Comparison of configurations of an experiment: groups, means, Pareto front. Pages and reports both use this module.

A configuration is a set of options without object and seed. Its means follow four rules:

- Objects differ in difficulty. All means are over the same objects: those with results of every compared configuration.
- Seeds of an object are averaged first, so an object counts once, whatever the number of its jobs.
- A configuration with results on less than half of the objects, such as one that has just started, is left out.
- A job that reused the calibration of an earlier job is charged for it, so every job pays for its calibration.
"""

from collections.abc import Callable, Hashable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from statistics import fmean, stdev
from typing import Any, Final, Generic, TypeVar

from trompe_shared.api import OPTIONS

K = TypeVar("K", bound=Hashable)
T = TypeVar("T")

_VIEWS: Final = {name for name, option in OPTIONS.items() if option.part == "views"}
PROBED: Final = {"surrogate", *_VIEWS} - {"held_out", "pool"}
"""Options on which a calibration depends, besides the seed; of a pool only the number of its first views counts."""


@dataclass(frozen=True)
class Job(Generic[K]):
    """A finished job.

    cost: a quantity to minimise, such as seconds. drop: ``A_drop`` on held-out views, on the attacked ones if there are
    none. calibration: probe renders and seconds of the calibration. same_probes: equal for jobs with the same probes.
    """

    object: str
    configuration: K
    seed: int
    cost: float
    drop: float
    calibration: tuple[int, float] = (0, 0.0)
    same_probes: Hashable = None


@dataclass(frozen=True)
class Mean(Generic[K]):
    """Mean cost and drop of a configuration. spread: deviation over seeds of the mean drop over objects; 0 for one."""

    configuration: K
    cost: float
    drop: float
    spread: float


def grouped(items: Iterable[T], key: Callable[[T], K]) -> dict[K, list[T]]:
    """Items by ``key``, in the order of the first item of each key."""
    groups: dict[K, list[T]] = {}
    for item in items:
        groups.setdefault(key(item), []).append(item)
    return groups


def average(values: Iterable[float | None]) -> float | None:
    """The mean without n.a. values (``None``); ``None`` if all are."""
    known = [value for value in values if value is not None]
    return fmean(known) if known else None


def differing_options(jobs: Sequence[tuple[str, Mapping[str, Any]]]) -> list[str]:
    """Names of the options in which jobs (object, options) on the same object differ; epsilon in any case."""
    first: dict[str, Mapping[str, Any]] = {}
    differ = {"epsilon"}
    for object, options in jobs:
        reference = first.setdefault(object, options)
        differ |= {name for name in options if options[name] != reference[name]}
    return [name for _, options in jobs[:1] for name in options if name in differ]


def charged(jobs: Iterable[Job[K]]) -> list[Job[K]]:
    """Jobs whose cost in seconds includes a calibration that an earlier job with the same probes paid for."""
    jobs = list(jobs)
    paid = {key: max(job.calibration for job in group) for key, group in grouped(jobs, lambda j: j.same_probes).items()}

    def missing(job: Job[K]) -> float:
        renders, seconds = paid[job.same_probes]
        return max(0.0, seconds - job.calibration[1]) if job.calibration[0] < renders else 0.0

    return [replace(job, cost=job.cost + missing(job)) for job in jobs]


def means_of(jobs: Sequence[Job[K]]) -> tuple[list[Mean[K]], set[str]]:
    """Means of the compared configurations, and the objects they are over: see the module's rules.

    Both are empty if the configurations have no object in common.
    """
    groups = grouped(jobs, lambda job: job.configuration)
    objects = {name: {job.object for job in group} for name, group in groups.items()}
    enough = len({job.object for job in jobs}) / 2
    compared = [name for name, own in objects.items() if len(own) >= enough]
    common = set.intersection(*(objects[name] for name in compared)) if compared else set()
    if not common:
        return [], common
    return [_mean(name, [job for job in groups[name] if job.object in common]) for name in compared], common


def _mean(configuration: K, jobs: Sequence[Job[K]]) -> Mean[K]:
    by_object = grouped(jobs, lambda job: job.object).values()
    cost, drop = (fmean(fmean(getattr(job, name) for job in part) for part in by_object) for name in ("cost", "drop"))
    seeds = grouped(jobs, lambda job: job.seed).values()  # only whole ones: objects differ more than seeds
    by_seed = [fmean(job.drop for job in part) for part in seeds if len({job.object for job in part}) == len(by_object)]
    return Mean(configuration, cost, drop, stdev(by_seed) if len(by_seed) > 1 else 0.0)


def pareto_front(means: Iterable[Mean[K]]) -> list[Mean[K]]:
    """Means that no other one beats in both cost and drop, from the cheapest to the best; of equal ones the first."""
    front: list[Mean[K]] = []
    for mean in sorted(means, key=lambda mean: (mean.cost, -mean.drop)):
        if not front or mean.drop > front[-1].drop:
            front.append(mean)
    return front
