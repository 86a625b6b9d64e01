"""What can be chosen when a worker starts."""

from dataclasses import dataclass, field

__all__ = ["Options", "Quality"]


@dataclass(frozen=True)
class Quality:
    """How finely pictures are drawn; docs/worker.md has the cost of each.

    ``msaa`` is the number of coverage samples a pixel (1 is none), ``shadow_map`` the side of a shadow map in texels,
    ``supersample`` the number of shaded samples along each side of a pixel, ``anisotropy`` how many times longer
    than wide the footprint of a pixel may be that textures are averaged over.
    """

    shadows: bool = True
    msaa: int = 4
    shadow_map: int = 1024
    supersample: int = 1
    anisotropy: int = 1


@dataclass(frozen=True)
class Options:
    """``depth_range``: metres that white stands for in a depth view. ``time_step``: seconds that pass in the world from
    one frame of an agent to its next; ``None`` is as many as pass on the clock."""

    quality: Quality = field(default_factory=Quality)
    depth_range: float = 10.0
    time_step: float | None = None
