"""Views of the attack, random or the paper's grid."""

from dataclasses import dataclass, field

import numpy as np

from trompe_shared.api import PAPER_AZIMUTHS, Colour, ViewRanges
from trompe_shared.errors import SpecError
from trompe_shared.geometry import Camera, Light, View

Range = tuple[float, float]


@dataclass(frozen=True)
class ViewDistribution:
    """Random cameras, lights and backgrounds, each quantity uniform in its range.

    distance: metres from ``centre``, the point (x, y, z) that cameras look at. elevation: degrees. ranges: the other
    quantities. backgrounds: sRGB, 0..255, equally likely.

    Raises ``SpecError`` for an elevation range with exchanged ends or over a pole, a distance of 0 or less, and no
    background.
    """

    distance: float
    elevation: Range
    ranges: ViewRanges = field(default_factory=ViewRanges)
    backgrounds: tuple[Colour, ...] = ((255, 255, 255),)
    centre: tuple[float, float, float] = (0.0, 0.0, 0.0)

    def __post_init__(self) -> None:
        low, high = self.elevation
        if not -90 <= low <= high <= 90:
            raise SpecError(f"elevation must be a range within -90..90, low end first; got {low} {high}.")
        if not 0 < self.distance < np.inf:
            raise SpecError(f"distance must be more than 0 m; got {self.distance}.")
        if not self.backgrounds:
            raise SpecError("No background for the views; give at least one colour.")

    def sample(self, n: int, *, generator: np.random.Generator) -> list[View]:
        """``n`` views, drawn one after the other: with the same seed, fewer views are the first of more.

        Each quantity takes its random number even if its range is a single value, so that fixing one does not change
        the others. Roll, intensity, ambient, colours and backgrounds use a spawned stream.
        """
        extra = generator.spawn(1)[0]
        return [
            View(self._camera(generator, extra), self._light(generator, extra), self._behind(extra)) for _ in range(n)
        ]

    def _camera(self, generator: np.random.Generator, extra: np.random.Generator) -> Camera:
        ranges = self.ranges
        distance = self.distance * generator.uniform(*ranges.distance_factor)
        azimuth, elevation = generator.uniform(*ranges.azimuth), generator.uniform(*self.elevation)
        return Camera(distance, azimuth, elevation, extra.uniform(*ranges.roll), self.centre)

    def _light(self, generator: np.random.Generator, extra: np.random.Generator) -> Light:
        ranges = self.ranges
        azimuth, elevation = generator.uniform(*ranges.light_azimuth), generator.uniform(*ranges.light_elevation)
        intensity, ambient, share = extra.uniform(*ranges.intensity), extra.uniform(*ranges.ambient), extra.uniform()
        red, green, blue = (round(a + share * (b - a)) for a, b in zip(*ranges.light_colours, strict=True))
        return Light(azimuth, elevation, intensity, ambient, (red, green, blue))

    def _behind(self, extra: np.random.Generator) -> Colour:
        return self.backgrounds[int(extra.uniform() * len(self.backgrounds))]


def grid_views(
    *,
    distance: float,
    elevation: tuple[float, float],
    azimuths: int | None,
    elevations: int,
    background: tuple[int, int, int],
    centre: tuple[float, float, float] = (0.0, 0.0, 0.0),
) -> list[View]:
    """A grid of azimuths and elevations, lit from the front at elevation 75.

    azimuths: how many, evenly spaced; ``None`` for the paper's six (0..360, both ends: the last repeats the first).
    """
    around = np.linspace(0, 360, PAPER_AZIMUTHS) if azimuths is None else np.arange(azimuths) * (360 / azimuths)
    return [
        View(Camera(distance, float(a), float(e), centre=centre), Light(), background)
        for e in np.linspace(*elevation, elevations)
        for a in around
    ]
