"""Checks of values from agents: finite and in range."""

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from typing import Final

from trompe_shared.errors import RendererError

Vector = tuple[float, float, float]
Ints = tuple[int, int, int]

WHITE: Final[Ints] = (255, 255, 255)


@contextmanager
def described(what: str) -> Iterator[None]:
    """Turn errors of a wrong JSON description within a ``with`` block into a ``RendererError``."""
    try:
        yield
    except (ValueError, KeyError, TypeError, AttributeError, OverflowError, RecursionError) as error:
        raise RendererError(f"{what} is wrong: {type(error).__name__} {error}.") from error


def checked_number(value: float, what: str, *, low: float = -1e6, high: float = 1e6) -> float:
    """``value`` if it lies in [low, high]. Raises ``RendererError``."""
    if not low <= value <= high:
        raise RendererError(f"A {what} must be a number from {low:g} to {high:g}, got {value!r}.")
    return float(value)


def checked_vector(values: Sequence[float], what: str) -> Vector:
    """Three finite numbers below a million. Raises ``RendererError``."""
    x, y, z = (float(value) for value in values)
    if not all(abs(value) < 1e6 for value in (x, y, z)):
        raise RendererError(f"A {what} must be three finite numbers, got {tuple(values)}.")
    return (x, y, z)


def checked_color(values: Ints) -> Ints:
    """Three integers from 0 to 255. Raises ``RendererError``."""
    if not all(0 <= value <= 255 for value in values):
        raise RendererError(f"A colour must be three integers from 0 to 255, got {tuple(values)}.")
    return values


def unit_color(color: Ints) -> Vector:
    """``color`` scaled to [0, 1]."""
    red, green, blue = (value / 255.0 for value in color)
    return (red, green, blue)
