"""What a check reports, and the remedy of each fault."""

from collections.abc import Mapping
from dataclasses import dataclass
from functools import partial
from typing import Final, Literal

REMEDIES: Final[Mapping[str, str]] = {
    "not repeatable": "Reset what one picture leaves to the next (jitter, exposure, history), or declare "
    "EngineInfo(deterministic=False) and draw the noise from noise_seed(world).",
    "late picture": "Finish the picture of this request before it is read back.",
    "noise not numbered": "Seed the engine with noise_seed(world) before each picture, or fix what else differs.",
    "noise number ignored": "Seed the engine with noise_seed(world), not with a constant; if its pictures are always "
    "equal, declare deterministic=True.",
    "invisible": "Place Snapshot.instances by their poses, use Snapshot.camera, and clip nothing between 0.1 and 10 m.",
    "untextured": "Bind each part's albedo, obj.textures[obj.albedo_of(part)].",
    "channel order": "Return the channels in the order red, green, blue: picture[..., ::-1] turns BGR into RGB.",
    "background": "Fill the background with Snapshot.background, sRGB, after any tone mapping, vignette and dithering.",
    "extra object": "Draw nothing but Snapshot.instances, before a plain background: no ground, grid, axes or text.",
    "stale scene": "Remove the objects of the last picture that are not in Snapshot.instances.",
    "stale object": "Find cached objects by HashedModel.key, not by name or number.",
    "stale texture": "Find cached textures by HashedModel.albedos, not by file name.",
    "moved object": "Place Snapshot.instances by their poses: do not centre or scale them. Right is +x, up is +y.",
    "mirrored": "Flip the columns: picture[:, ::-1]. Trompe's world is right-handed.",
    "upside down": "Flip the rows: picture[::-1]. OpenGL reads row 0 at the bottom.",
    "axes": "Right is +x, up is +y, and the camera looks along its own -z; convert z-up engines at the root.",
    "inside out": "Cull the faces seen from behind (clockwise), not those seen from the front.",
    "parts": "Draw every part of obj.parts, with its own albedo: obj.textures[obj.albedo_of(part)].",
    "depth": "Turn the depth test on (less wins), with a depth buffer in the framebuffer.",
    "orthographic": "Use a perspective projection of 60 degrees.",
    "camera": "Take Snapshot.camera (camera to world) whole; the camera need not be upright nor look at the origin.",
    "v flipped": "v = 0 is the bottom row of the texture: use 1 - v, or flip the rows of the texture.",
    "u flipped": "u = 0 is the left column of the texture: use u as it is.",
    "texture not repeated": "Repeat textures in u and v (GL_REPEAT): coordinates may lie outside [0, 1].",
    "texture turned": "u runs along the rows of the texture, v up its columns: do not transpose it. Wrap "
    "coordinates for each pixel, not at vertices.",
    "field of view": "60 degrees (FIELD_OF_VIEW) is the vertical field of view.",
    "aspect": "Set the camera's aspect to width / height for each picture, and keep the vertical field of view.",
    "sheared": "Read the rows without padding: in OpenGL glPixelStorei(GL_PACK_ALIGNMENT, 1).",
    "shifted": "Centre the picture on the camera's axis; pixel (0, 0) covers [0, 1] x [0, 1].",
    "overexposed": "Light of intensity 1 makes a white surface that faces it just white: lower lights or exposure.",
    "gamma missing": "Encode the picture: linear light to sRGB.",
    "gamma twice": "Encode the picture once: turn off either the engine's sRGB output or your own encoding.",
    "texture not decoded": "Mark the albedo texture as sRGB, so that the engine decodes it to linear light.",
    "texture decoded twice": "Decode the albedo texture once: mark it as sRGB or convert it yourself.",
    "light on encoded colours": "Mark the albedo texture as sRGB and encode the picture, if the engine can.",
    "exposure": "Turn off automatic exposure, fog and transparency: a colour must not depend on what is around it.",
    "light missing": "Apply Snapshot.lights; a directional light travels along its direction.",
    "light follows camera": "Place the light in the world, not below the camera.",
    "light reversed": "WorldLight.direction is the way the light travels; negate it if the engine wants the opposite.",
    "light direction": "Turn WorldLight.direction into the engine's axes like positions.",
    "light intensity": "Multiply the light by WorldLight.intensity (and by pi where the engine divides by it).",
    "light balance": "Intensity 1 and ambient light of 1 both make a white surface white: look for a factor of pi.",
    "light colour": "Multiply the light by WorldLight.color / 255, linear: red, green, blue; do not decode it as sRGB.",
    "ambient missing": "Add Snapshot.ambient, light from all sides, to the directional lights.",
    "extra light": "Take all light from Snapshot.lights and .ambient: turn off the engine's own sky, lamps and fog.",
    "not shaded": "Keep shading on where Snapshot.lights is empty: add a black light if the engine needs one.",
    "frozen texture": "Read obj.textures (obj.files keeps the old paint); find cached textures by HashedModel.albedos.",
    "late texture": "Finish the upload of a texture before the picture is drawn.",
    "clipped": "Clip nothing between 0.1 and 10 m.",
    "slow": "A job takes about 1,000 pictures: use fewer samples, or several workers.",
}
FINAL: Final = {
    "late picture",
    "invisible",
    "extra object",
    "untextured",
    "texture turned",
    "stale scene",
    "stale object",
    "stale texture",
    "moved object",
    "axes",
    "inside out",
    "parts",
    "exposure",
    "overexposed",
}
"""Faults after which other questions have no answer."""


@dataclass(frozen=True)
class Finding:
    """One line of a check. name: a key of ``REMEDIES``, or the question of which all is well; seen: with figures."""

    level: Literal["ok", "warning", "fault"]
    name: str
    seen: str

    def __str__(self) -> str:
        word, remedy = ("ok", "") if self.level == "ok" else (self.level.upper(), REMEDIES.get(self.name, ""))
        return f"{word:<8} {self.name}: {self.seen} {remedy}".rstrip()


ok, warning, fault = (partial(Finding, level) for level in ("ok", "warning", "fault"))
