"""OBJ with MTL or SAILenv's mat_def: kept if complete, otherwise completed with maps and UVs."""

import posixpath
import re
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from dataclasses import replace
from typing import Final

import numpy as np
from numpy.typing import NDArray

from trompe_server.formats.assembly import DEFAULT_COLOUR, free_name, painted_flat, repainted, safe_name
from trompe_server.formats.pictures import shrink
from trompe_server.formats.upload import Upload
from trompe_shared.errors import ObjectError
from trompe_shared.local_files import (
    PICTURE_SUFFIXES,
    base_name,
    encoding_of,
    libraries,
    library_names,
    named,
    text_of,
)
from trompe_shared.object3d import (
    Object3D,
    decode_alpha,
    decode_rgb,
    definition_of,
    encode_png,
    mtl_texts,
    object_from_files,
    with_alpha_of,
)
from trompe_shared.wavefront import NO_MATERIAL, Part, Surface, obj_text, parse_mtl, parse_surfaces, textured

ROOTED: Final = re.compile(r"(?<=\s)(/|\\\\|[A-Za-z]:[/\\]).*", re.DOTALL)
"""A path from the root of a machine, at the end of a line."""


def read(upload: Upload) -> Object3D:
    """Read an OBJ and the files beside it. Raises ``ObjectError``."""
    return _object(_completed(upload))


def _completed(upload: Upload) -> Mapping[str, bytes]:
    files = upload.flat()
    return complete(files) if definition_of(files) is None else files


def _object(files: Mapping[str, bytes]) -> Object3D:
    return object_from_files(dissolved(files) if definition_of(files) is None else files)


def repaint(upload: Upload, painted: Object3D) -> Upload:
    """``upload`` with the textures of ``painted`` and the added maps and UVs. Raises ``ObjectError``."""
    files = _completed(upload)
    changed = repainted(_object(files), painted)
    if not changed:
        return upload
    pngs = {name: with_alpha_of(rgb, decode_alpha(files[name], name)) for name, rgb in changed.items()}
    places = {base_name(path): path for path in upload.files}
    return upload.with_flat(_rewritten({**files, **pngs}, lambda mtl, line: _relative(line, mtl, pngs.keys(), places)))


def _relative(line: str, mtl: str, pictures: Collection[str], places: Mapping[str, str]) -> str:
    """A line of ``mtl`` with a path from the root of a machine to one of ``pictures`` made relative: the machine may
    have the old picture there. places: paths in the upload by name."""
    for picture in parse_mtl(f"newmtl m\n{line}")["m"].values():
        if picture in pictures and (found := ROOTED.search(line)) is not None:
            end = line[len(line.rstrip("\r\n")) :]
            place = posixpath.relpath(places[picture], posixpath.dirname(places[mtl]) or ".")
            return f"{line[: found.start()]}{place}{end}"
    return line


def shrunk(obj: Object3D, side: int | None) -> Object3D:
    """``obj`` with maps of at most ``side`` texels a side, of any size for ``None``; reduced maps become PNGs."""
    if side is None:
        return obj
    files = dict(obj.files)
    for name in obj.maps:
        rgb, alpha = decode_rgb(files[name], name), decode_alpha(files[name], name)
        if (small := shrink(rgb, side)) is not rgb:
            files[name] = with_alpha_of(small, alpha)
    return obj if files == obj.files else object_from_files(files)


def complete(files: Mapping[str, bytes]) -> dict[str, bytes]:
    """Complete the ``files`` of an OBJ: a texture for each material without one, UVs for each mesh without any.

    Complete files stay unchanged. An MTL gets the missing lines and the capitals of the pictures' files. A changed OBJ
    is rewritten.
    """
    return _Completion(_spelled(files)).files_of()


def _spelled(files: Mapping[str, bytes]) -> dict[str, bytes]:
    """``files`` with the capitals of pictures' names in MTLs as in the files' names; Windows takes either."""
    return _rewritten(files, lambda _, line: _respelled(line, files))


def _rewritten(files: Mapping[str, bytes], change: Callable[[str, str], str]) -> dict[str, bytes]:
    """``files`` with a ``change`` of each line of the MTLs; its arguments are an MTL's name and the line."""
    texts = {
        name: (text, "".join(change(name, line) for _, line in _lines(text))) for name, text in mtl_texts(files).items()
    }
    return dict(files) | {name: _encoded(after, files[name]) for name, (text, after) in texts.items() if after != text}


def _respelled(line: str, files: Mapping[str, bytes]) -> str:
    for picture in parse_mtl(f"newmtl m\n{line}")["m"].values():
        if (found := named(picture, files)) is not None:
            before, _, after = line.rpartition(picture)
            return f"{before}{found}{after}"
    return line


def _encoded(text: str, before: bytes) -> bytes:
    """``text`` in the encoding of the file ``before`` the change, or in UTF-8 if that lacks a character."""
    try:
        return text.encode(encoding_of(before))
    except UnicodeEncodeError:
        return text.encode()


def dissolved(files: Mapping[str, bytes]) -> dict[str, bytes]:
    """``files`` with each opacity picture (``map_d``) of the MTL as the alpha channel of its albedo.

    A ``map_d`` that names the albedo itself means its alpha channel. Raises ``ObjectError`` for an albedo with several.
    """
    masks: dict[str, str] = {}
    for text in mtl_texts(files).values():
        for albedo, mask in ((maps.get("albedo", ""), maps.get("map_d", "")) for maps in parse_mtl(text).values()):
            if albedo in files and mask in files and masks.setdefault(albedo, mask) != mask:
                raise ObjectError(
                    f"The MTL gives the texture {albedo!r} two opacities (map_d), {masks[albedo]!r} and {mask!r}. "
                    "Save the texture under a name for each."
                )
    return dict(files) | {
        albedo: with_alpha_of(decode_rgb(files[albedo], albedo), _grey(files[mask], mask))
        for albedo, mask in masks.items()
        if mask != albedo
    }


def _grey(data: bytes, name: str) -> NDArray[np.uint8]:
    """The alpha channel of a picture, or its brightness, (H, W)."""
    alpha = decode_alpha(data, name)
    return np.rint(decode_rgb(data, name).mean(axis=2)).astype(np.uint8) if alpha is None else alpha


class _Completion:
    def __init__(self, files: dict[str, bytes]) -> None:
        self._files = files
        self._mesh = next(name for name in files if name.lower().endswith(".obj"))
        self._text = text_of(files[self._mesh])
        self._libraries = mtl_texts(files)
        self._surfaces = parse_surfaces(self._text, self._mesh)
        self._parts: list[Part] = []
        self._rewritten = not self._libraries

    def files_of(self) -> dict[str, bytes]:
        """The completed files."""
        if not self._libraries:
            self._refuse_lost_pictures()
            self._surfaces = tuple(
                replace(surface, material=safe_name(surface.material, default="default")) for surface in self._surfaces
            )
            names = dict.fromkeys(surface.material for surface in self._surfaces)
            self._libraries = {f"{self._mesh[:-4]}.mtl": "".join(f"newmtl {name}\n" for name in names)}
        texts = dict(self._libraries)
        self._define_missing()
        for surface in self._surfaces:
            self._add(surface)
        changed = {name: text for name, text in self._libraries.items() if text != texts[name]}
        if self._rewritten:
            changed |= self._libraries
            written = libraries(self._text, self._libraries).values()
            changed[self._mesh] = obj_text(tuple(self._parts), libraries=written)
        return self._files | {name: _encoded(text, self._files.get(name, b"")) for name, text in changed.items()}

    def _maps(self) -> dict[str, dict[str, str]]:
        return {name: maps for text in reversed(self._libraries.values()) for name, maps in parse_mtl(text).items()}

    def _define_missing(self) -> None:
        """Define the material of faces without one, unless the mesh names none of those there are."""
        used, known = {surface.material for surface in self._surfaces}, self._maps()
        if used == {NO_MATERIAL} and known and NO_MATERIAL not in known:
            raise ObjectError(
                f"{self._mesh!r} names no material (usemtl), though the .mtl defines {sorted(known)[:4]}. Name one "
                "before the faces, or leave the .mtl and its pictures away for a plain object."
            )
        if NO_MATERIAL in used and NO_MATERIAL not in known:
            first, text = next(iter(self._libraries.items()))
            self._libraries[first] = f"{text}\nnewmtl {NO_MATERIAL}\n"
            self._rewritten = True

    def _refuse_lost_pictures(self) -> None:
        """Raise ``ObjectError`` if the mesh is ready for a picture that no material names."""
        if not any(surface.uvs is not None and surface.colours is None for surface in self._surfaces):
            return
        if pictures := [name for name in self._files if name.lower().endswith(tuple(PICTURE_SUFFIXES))]:
            raise ObjectError(
                f"There is no .mtl beside {self._mesh!r}, so nothing says what {sorted(pictures)[:4]} is for. Add the "
                ".mtl, with map_Kd for the albedo, or leave the pictures away for a plain object."
            )
        if names := library_names(self._text):
            raise ObjectError(
                f"{self._mesh!r} names the materials file {names[0]!r}, which did not come with it. Add it and its "
                "pictures (a zip or folder holds all), or delete the line 'mtllib' for a plain grey object."
            )

    def _add(self, surface: Surface) -> None:
        maps = self._maps()
        if surface.material not in maps:
            raise ObjectError(
                f"{self._mesh!r} uses the undefined material {surface.material!r}; the .mtl defines "
                f"{sorted(maps) or 'none'}."
            )
        if "albedo" in maps[surface.material]:
            self._parts.append(textured(surface, self._mesh))
            return
        part, picture = painted_flat(surface, self._colour(surface))
        self._rewritten |= part.uvs is not surface.uvs
        self._parts.append(part)
        name = free_name(f"{safe_name(surface.material)}_albedo.png", self._files)
        self._files[name] = encode_png(picture)
        self._libraries = {k: _with_map(text, surface.material, name) for k, text in self._libraries.items()}

    def _colour(self, surface: Surface) -> Sequence[float]:
        """Linear colour of a material in the MTL; white for vertex colours."""
        if surface.colours is not None:
            return (1.0, 1.0, 1.0)
        for text in self._libraries.values():
            for material, line in _lines(text):
                if material == surface.material and line.split(maxsplit=1)[:1] == ["Kd"]:
                    return _numbers(line, surface.material)
        return DEFAULT_COLOUR


def _lines(text: str) -> Iterator[tuple[str | None, str]]:
    """Each line of an MTL with its material."""
    material = None
    for line in text.splitlines(keepends=True):
        words = line.split(maxsplit=1)
        if len(words) == 2 and words[0] == "newmtl":
            material = words[1].strip()
        yield material, line


def _numbers(line: str, material: str) -> tuple[float, float, float]:
    try:
        red, green, blue = (min(max(float(word), 0.0), 1.0) for word in line.split()[1:4])
    except ValueError as error:
        raise ObjectError(
            f"Material {material!r}: {line.strip()[:60]!r} is not a colour; expected Kd and three numbers."
        ) from error
    return red, green, blue


def _with_map(text: str, material: str, name: str) -> str:
    """The MTL with the texture ``name`` in place of the colour of ``material``."""
    lines = []
    for current, line in _lines(text if text.endswith("\n") else text + "\n"):
        word = next(iter(line.split(maxsplit=1)), "")
        lines.append("Kd 1 1 1\n" if (current, word) == (material, "Kd") else line)
        if (current, word) == (material, "newmtl"):
            lines.append(f"map_Kd {name}\n")
    return "".join(lines)
