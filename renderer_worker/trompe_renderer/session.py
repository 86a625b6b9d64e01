"""One agent's state: its scene, its camera, what stands behind all. No sockets, no OpenGL, no clock.

Each method answers the command of its name in ``trompe_shared.sailenv.COMMANDS`` with the values of the reply, and
refuses by raising a ``TrompeError`` whose message becomes the reason. Lights and objects have files of their own.
"""

from collections.abc import Mapping
from typing import Any, Final

import numpy as np
from PIL import Image, ImageOps

from trompe_renderer.dynamics import frustum_walls
from trompe_renderer.lights import LightCommands
from trompe_renderer.model import Library, content_key
from trompe_renderer.scenario import Actor, read_script
from trompe_renderer.scenery import Backdrop, Matrix, Photograph, Scenery, Sky
from trompe_renderer.scenes import OBJECT_VIEW, SCENES, Scene, scene_named
from trompe_renderer.values import Ints, Vector, checked_color, checked_vector, unit_color
from trompe_renderer.world import ObjectCommands, placed
from trompe_shared.errors import RendererError, TrompeError
from trompe_shared.geometry import FIELD_OF_VIEW, unity_to_opengl_rotation
from trompe_shared.object3d import decode_rgb
from trompe_shared.sailenv import EXTENSIONS

__all__ = ["Session"]

FRUSTUM_NEAR: Final = 0.3
FRUSTUM_FAR: Final = 15.0
"""Metres; what SAILenv's git client says where it says it."""


class Session(LightCommands, ObjectCommands):
    """State and answers for one agent, used by one thread. ``size`` is its images' (width, height)."""

    def __init__(self, library: Library) -> None:
        LightCommands.__init__(self)
        ObjectCommands.__init__(self, library)
        self.size = (1, 1)
        self._take = 0
        self._error = ""
        self._refusals: list[str] = []
        self._load(scene_named(OBJECT_VIEW))
        self._stand_at(scene_named(OBJECT_VIEW))

    def _load(self, scene: Scene) -> None:
        """Start anew in ``scene``; the camera stays where it is."""
        self._take += 1
        self._light_up(scene.lamps, scene.ambient)
        self._furnish(scene.fixtures, scene.walls)
        self._backdrop: Backdrop = scene.backdrop if isinstance(scene.backdrop, Sky) else unit_color(scene.backdrop)

    def _stand_at(self, scene: Scene) -> None:
        self._position, self._rotation = scene.position, scene.rotation

    def advance(self, seconds: float) -> None:
        """Let time pass for what moves by itself."""
        self._let_pass(seconds)

    def scenery(self) -> Scenery:
        """What the agent's camera sees, for the engine."""
        return Scenery(
            placements=self._placements(),
            camera=self._camera(),
            lights=tuple(lamp.light() for lamp in self._lamps.values() if lamp.intensity > 0),
            ambient=unit_color(self._ambient),
            backdrop=self._backdrop,
            take=self._take,
        )

    def _camera(self) -> Matrix:
        camera = np.eye(4)
        camera[:3, :3] = unity_to_opengl_rotation(np.array(self._rotation))
        camera[:3, 3] = self._position
        return camera

    def note_refusal(self, reason: str) -> None:
        """Keep the reason of a refusal for ``last_error``."""
        self._error = reason

    def take_refusals(self) -> list[str]:
        """What the last command refused while it did the rest."""
        refusals, self._refusals = self._refusals, []
        return refusals

    def last_error(self) -> tuple[str]:
        reason, self._error = self._error, ""
        return (reason,)

    @property
    def scenes(self) -> list[str]:
        """Names of the scenes there are."""
        return list(SCENES)

    def change_scene(self, *, scene: str) -> tuple[()]:
        wanted = scene_named(scene)
        self._load(wanted)
        self._stand_at(wanted)
        return ()

    def load_scenario(self, *, scenario: Mapping[str, Any]) -> tuple[str, ...]:
        """Load a scene and spawn objects; the camera stays. An id for each, "" for one that is not spawned."""
        try:
            script = read_script(scenario)
            scene = scene_named(script.scene)
        except TrompeError as error:
            self._refusals.append(str(error))
            return ("",) * len(scenario["objects"])
        self._load(scene)
        if script.reach is not None:
            self._see_as_far_as(script.reach)
        return tuple(self._enter(actor, delay) for actor, delay in zip(script.actors, script.delays, strict=True))

    def _enter(self, actor: Actor | str, delay: float) -> str:
        try:
            if isinstance(actor, str):
                raise RendererError(actor)
            place = placed(actor.position, actor.rotation)
            size = (1.0, 1.0, 1.0)
            return self._spawn(actor.name, place, size, motion=actor.motion, limited=actor.limited, delay=delay)
        except TrompeError as error:
            self._refusals.append(str(error))
            return ""

    def spawn_view_frustum(self) -> tuple[()]:
        """From now on objects that move by themselves bounce off the edges of what the camera sees at this moment."""
        self._see_as_far_as(FRUSTUM_FAR)
        return ()

    def _see_as_far_as(self, far: float) -> None:
        aspect = self.size[0] / self.size[1]
        self._frustum = frustum_walls(
            self._camera(), field_of_view=FIELD_OF_VIEW, aspect=aspect, near=FRUSTUM_NEAR, far=far
        )

    def get_position(self) -> tuple[Vector]:
        return (self._position,)

    def set_position(self, *, position: Vector) -> tuple[()]:
        self._position = checked_vector(position, "position")
        return ()

    def get_rotation(self) -> tuple[Vector]:
        return (self._rotation,)

    def set_rotation(self, *, rotation: Vector) -> tuple[()]:
        self._rotation = checked_vector(rotation, "rotation")
        return ()

    def toggle_follow(self) -> tuple[()]:
        """In Unity the window on the screen follows the agent, or no longer does; here there is no window."""
        return ()

    def set_clear_color(self, *, color: Ints) -> tuple[()]:
        """A colour behind all objects; any negative number asks for the sky."""
        self._backdrop = Sky() if min(color) < 0 else unit_color(checked_color(color))
        return ()

    def set_background_picture(self, *, file: tuple[str, bytes]) -> tuple[()]:
        """A picture behind all objects, cropped and scaled to the image, as the main view is sent."""
        picture = Image.fromarray(decode_rgb(file[1], file[0]))
        fitted = np.asarray(ImageOps.fit(picture, self.size, Image.Resampling.LANCZOS))[:, ::-1]
        self._backdrop = Photograph(content_key(repr(self.size).encode(), fitted), fitted)
        return ()

    def get_light_type(self, *, light: str) -> tuple[str]:
        return (EXTENSIONS,) if light == EXTENSIONS else super().get_light_type(light=light)
