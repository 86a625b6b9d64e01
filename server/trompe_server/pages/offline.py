"""A result as one HTML file that opens without a network: images, map, figures, and the object to turn."""

import io
from base64 import b64encode
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any, Final

from markupsafe import Markup
from PIL import Image

from trompe_server.api.services import Services
from trompe_server.errors import NotFoundError
from trompe_server.formats import write_glb
from trompe_server.pages.orbit import orbit, painted
from trompe_server.pages.present import TERMS, JobRow, Shown
from trompe_server.pages.results import Kind, target_image
from trompe_server.pages.serving import STATIC, render
from trompe_server.pages.sphere import sphere
from trompe_server.storage.folders import JobArtifacts
from trompe_shared.api import Job, Result
from trompe_shared.object3d import Object3D, open_image
from trompe_shared.three import FOLDER, LIGHTS, THREE

LIMIT: Final = 8 * 2**20
"""Bytes of the file; what follows and three.js are less together."""
MODEL_BYTES: Final = 4_400_000
"""Both models in base64. Larger ones get smaller textures; without these too, the file is without them."""
PICTURE_BYTES: Final = 1_400_000
"""All images of views; of more, views at equal steps are taken."""
SIDES: Final = (1024, 512, 256)
"""Longest sides of textures, texels."""
QUALITY: Final = 88
"""Of JPEG and WebP."""
SAID: Final = ("says", "kept", "truth")
"""Fields of a view, for before and for after, that the orbit shows."""

Record = Mapping[str, Any]


def offline_page(services: Services, job: Job, row: JobRow, shown: Shown) -> str:
    """HTML of the result of ``job``. Raises ``MissingFileError`` if its images are not stored any more."""
    views: Sequence[Record] = shown.viewer[0]["views"]
    pictured = _pictured(services, job, views)
    return render(
        "offline.html",
        job=row,
        shown=replace(shown, viewer=[{**shown.viewer[0], "views": pictured}], sphere=sphere([pictured])),
        terms=TERMS,
        orbit=_orbit(services, job, shown.result, views),
        style=Markup((STATIC / "trompe.css").read_text()),
        scripts=[Markup((STATIC / name).read_text()) for name in ("viewer.js", "orbit.js")],
    )


def _pictured(services: Services, job: Job, views: Sequence[Record]) -> list[Record]:
    """Records of the views with their images inside; of many views, some at equal steps."""
    artifacts = services.artifacts(job.id)

    def pictured(view: Record) -> Record:
        images = {side: _image(artifacts, view[side]) for side in ("before", "after")}
        return {**view, **images, "difference": None}

    first = pictured(views[0])
    step = -(-len(views) * (len(first["before"]) + len(first["after"])) // PICTURE_BYTES)
    return [first, *map(pictured, views[step::step])]


def _image(artifacts: JobArtifacts, path: str) -> str:
    """The image with this path on the pages, as an address that holds it."""
    *_, view_set, index, file = path.split("/")
    kind: Kind = "after" if file == "after.png" else "before"
    return _address(_packed(Image.fromarray(target_image(artifacts, view_set, int(index), kind)), "WEBP"), "image/webp")


def _orbit(services: Services, job: Job, result: Result, views: Sequence[Record]) -> Record | None:
    """The orbit with everything inside, which shows the answers of the nearest of ``views``."""
    given = orbit(result, job.id, ())
    models = given and _models(services, job)
    if not given or not models:
        return None
    scripts = (("three", THREE), ("lights", LIGHTS))
    files = {name: _address((FOLDER / file).read_bytes(), "text/javascript") for name, file in scripts}
    said = ("azimuth", "elevation", "where", *(f"{what}_{side}" for what in SAID for side in ("before", "after")))
    few = [{name: view[name] for name in said} for view in views]
    return {**given, "classifiers": None, "files": files, "models": models, "views": few}


def _models(services: Services, job: Job) -> Mapping[str, str] | None:
    """Addresses of the models before and after; ``None`` if they are too large or not stored."""
    try:
        both = {side: painted(services, job, side) for side in ("before", "after")}
    except NotFoundError:
        return None
    for side in SIDES:
        found = {name: _address(write_glb(_reduced(obj, side)), "model/gltf-binary") for name, obj in both.items()}
        if sum(map(len, found.values())) <= MODEL_BYTES:
            return found
    return None


def _reduced(obj: Object3D, side: int) -> Object3D:
    """The object with small files as textures, of at most ``side`` texels a side."""
    return replace(obj, files={**obj.files, **{name: _small(obj.files[name], name, side) for name in obj.maps}})


def _small(data: bytes, name: str, side: int) -> bytes:
    """The image as JPEG, or as PNG if it has alpha."""
    with open_image(data, name) as image:
        opaque = not image.has_transparency_data
        picture = image.convert("RGB" if opaque else "RGBA")
    picture.thumbnail((side, side))
    return _packed(picture, "JPEG" if opaque else "PNG")


def _packed(picture: Image.Image, kind: str) -> bytes:
    buffer = io.BytesIO()
    picture.save(buffer, kind, quality=QUALITY)
    return buffer.getvalue()


def _address(data: bytes, kind: str) -> str:
    return f"data:{kind};base64,{b64encode(data).decode()}"
