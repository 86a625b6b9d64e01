"""An object from all sides in the target renderer, for the form."""

from contextlib import closing
from typing import Final

import numpy as np
from fastapi import Response

from trompe_server.api.services import Services, ServicesDep
from trompe_server.pages.orbit import painted
from trompe_server.spec.framing import framing_of
from trompe_shared.addresses import host_and_port
from trompe_shared.api import JOB_RESULT, ViewOptions
from trompe_shared.api.jobs import Distance
from trompe_shared.colours import colour_of
from trompe_shared.errors import RendererError, SpecError
from trompe_shared.geometry import Camera, Light, View
from trompe_shared.object3d import Object3D, encode_png, load_object
from trompe_shared.sailenv_client import SailenvTarget

TURNS: Final = 12
SIDE: Final = 224
ELEVATION: Final = 25.0


def turntable(
    services: ServicesDep,
    reference: str,
    background: str = "white",
    distance: Distance | None = None,
    renderer: str = "",
) -> Response:
    """Route to ``TURNS`` pictures side by side as PNG, of a stored object or of a job's painted one (``job:ID``).

    ``renderer``: identity of the engine; default: the first one's. Raises ``RendererError`` if no such renderer is up.
    """
    renderers = [each for each in services.renderers() if each.alive and renderer in ("", each.identity)]
    if not renderers:
        asked = f" with the engine {renderer!r}" if renderer else ""
        raise RendererError(f"No renderer worker{asked} is up; start one with `trompe render`.")
    obj, source = _object(services, reference)
    framing = framing_of(obj, ViewOptions(distance=distance), shipped=source)
    behind = colour_of(background)
    if behind is None:
        raise SpecError(f"The background {background!r} is not a colour; use white, black or #rrggbb.")
    cameras = [Camera(framing.distance, 360 * k / TURNS, ELEVATION, centre=framing.centre) for k in range(TURNS)]
    views = [View(camera, Light(), behind) for camera in cameras]
    with closing(SailenvTarget(*host_and_port(renderers[0].address))) as target:
        images = target.render(obj, views, size=(SIDE, SIDE))
    return Response(encode_png(np.concatenate(list(images), axis=1)), media_type="image/png")


def _object(services: Services, reference: str) -> tuple[Object3D, str]:
    """The object, and the stored one that it was."""
    if not reference.startswith(JOB_RESULT):
        return load_object(services.library.object_bytes(reference)), reference
    job = services.store.get(reference.removeprefix(JOB_RESULT))
    return painted(services, job, "after"), job.attack.object
