"""The Pareto front: what nothing else beats in cost and in gain."""

from collections.abc import Callable, Iterable
from typing import TypeVar

__all__ = ["front_of"]

T = TypeVar("T")


def front_of(points: Iterable[T], *, cost: Callable[[T], float], gain: Callable[[T], float]) -> list[T]:
    """The points that no other one beats: none is as cheap or cheaper and as good or better, and better in one of both.

    From the cheapest to the best; of equal points the first.
    """
    front: list[T] = []
    for point in sorted(points, key=lambda p: (cost(p), -gain(p))):
        if not front or gain(point) > gain(front[-1]):
            front.append(point)
    return front
