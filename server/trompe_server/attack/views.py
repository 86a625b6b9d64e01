"""The views an attack is made for, and the ones it is judged on."""

from dataclasses import dataclass
from typing import Final

import numpy as np

from trompe_shared.api import VIEW_LIMITS
from trompe_shared.errors import SpecError
from trompe_shared.geometry import Camera, Light, View

__all__ = ["ViewDistribution", "grid_views"]

Range = tuple[float, float]
Colour = tuple[int, int, int]

LIGHT: Final = Light()


@dataclass(frozen=True)
class ViewDistribution:
    """What the paper's expectation is taken over: cameras, lights and backgrounds, each uniform in its range.

    A range is (low, high), angles in degrees. ``distance``, metres, is multiplied by ``distance_factor``. Light has a
    colour on the straight line between the two of ``light_colours`` (linear, 0..255); ``backgrounds`` (sRGB, 0..255)
    are equally likely.

    Raises ``SpecError`` for a range with its ends exchanged, beyond what there is, or no background.
    """

    distance: float
    elevation: Range
    azimuth: Range = (0.0, 360.0)
    distance_factor: Range = (0.9, 1.1)
    roll: Range = (0.0, 0.0)
    light_azimuth: Range = (-70.0, 70.0)
    light_elevation: Range = (35.0, 88.0)
    intensity: Range = (LIGHT.intensity, LIGHT.intensity)
    ambient: Range = (LIGHT.ambient, LIGHT.ambient)
    light_colours: tuple[Colour, Colour] = (LIGHT.colour, LIGHT.colour)
    backgrounds: tuple[Colour, ...] = ((255, 255, 255),)

    def __post_init__(self) -> None:
        for name, (least, most) in {"elevation": (-90.0, 90.0), **VIEW_LIMITS}.items():
            low, high = getattr(self, name)
            if not least <= low <= high <= most:
                raise SpecError(f"{name} must be a range within {least:g}..{most:g}, low end first; got {low} {high}.")
        if not 0 < self.distance < np.inf:
            raise SpecError(f"A camera must stand off the object; got distance {self.distance} m. Make it more than 0.")
        if not self.backgrounds:
            raise SpecError("Views need a background; give one colour at least.")
        colours = (*self.light_colours, *self.backgrounds)
        if not all(0 <= value <= 255 for colour in colours for value in colour):
            raise SpecError(f"Colours are three numbers within 0..255 each; got {colours}.")

    def sample(self, n: int, *, generator: np.random.Generator) -> list[View]:
        """``n`` views, drawn one after the other: of the same seed, fewer views are the first of more.

        Each quantity takes its random number even where its range is a single value, so that fixing one leaves the
        others as they were; those beyond distance, angles and the light's direction have a stream of their own.
        """
        more = generator.spawn(1)[0]
        return [View(self._camera(generator, more), self._light(generator, more), self._behind(more)) for _ in range(n)]

    def _camera(self, generator: np.random.Generator, more: np.random.Generator) -> Camera:
        distance = self.distance * generator.uniform(*self.distance_factor)
        azimuth, elevation = generator.uniform(*self.azimuth), generator.uniform(*self.elevation)
        return Camera(distance, azimuth, elevation, more.uniform(*self.roll))

    def _light(self, generator: np.random.Generator, more: np.random.Generator) -> Light:
        azimuth, elevation = generator.uniform(*self.light_azimuth), generator.uniform(*self.light_elevation)
        intensity, ambient, share = more.uniform(*self.intensity), more.uniform(*self.ambient), more.uniform()
        red, green, blue = (round(a + share * (b - a)) for a, b in zip(*self.light_colours, strict=True))
        return Light(azimuth, elevation, intensity, ambient, (red, green, blue))

    def _behind(self, more: np.random.Generator) -> Colour:
        return self.backgrounds[int(more.uniform() * len(self.backgrounds))]


def grid_views(
    *,
    distance: float,
    elevation: tuple[float, float],
    azimuths: int,
    elevations: int,
    background: tuple[int, int, int],
) -> list[View]:
    """The paper's views: a grid of azimuths (0..360, both ends) and elevations, lit from the front at elevation 75."""
    return [
        View(Camera(distance, float(a), float(e)), Light(), background)
        for e in np.linspace(*elevation, elevations)
        for a in np.linspace(0, 360, azimuths)
    ]
