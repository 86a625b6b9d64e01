"""An object from all around, as the target renderer shows it, before anything is attacked."""

from typing import Final

import numpy as np

from trompe_server.api.services import Services
from trompe_server.target.sailenv import SailenvTarget
from trompe_shared.errors import RendererError, SpecError
from trompe_shared.geometry import Camera, Light, View, colour_of, framing_distance
from trompe_shared.object3d import encode_png, load_object
from trompe_shared.shipped import shipped_objects

__all__ = ["TURNS", "turntable"]

TURNS: Final = 12
SIDE: Final = 224
ELEVATION: Final = 25.0


def turntable(services: Services, reference: str, *, background: str, distance: float | None) -> bytes:
    """``TURNS`` pictures side by side, PNG. Raises ``RendererError`` where no renderer is up."""
    renderers = [each for each in services.renderers() if each.alive]
    if not renderers:
        raise RendererError("No renderer worker is up; the object can be shown once one is.")
    obj = load_object(services.library.object_bytes(reference))
    shipped = shipped_objects().get(reference)
    away = distance or (shipped.distance if shipped else framing_distance(obj.radius))
    behind = colour_of(background)
    if behind is None:
        raise SpecError(f"The background {background!r} is no colour; give white, black or #rrggbb.")
    views = [View(Camera(away, 360 * k / TURNS, ELEVATION), Light(), behind) for k in range(TURNS)]
    host, _, port = renderers[0].address.rpartition(":")
    target = SailenvTarget(host, int(port))
    try:
        images = target.render(obj, views, size=(SIDE, SIDE))
    finally:
        target.close()
    return encode_png(np.concatenate(list(images), axis=1))
