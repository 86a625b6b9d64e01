"""OBJ with MTL or with SAILenv's mat_def: kept as it is where it is whole, completed where a map or UVs are missing."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace

from trompe_server.formats.assembly import DEFAULT_COLOUR, free_name, painted_flat, safe_name
from trompe_server.formats.comparison import repainted
from trompe_server.formats.pictures import decode, shrink, with_alpha_of
from trompe_server.formats.upload import Upload
from trompe_shared.errors import ObjectError
from trompe_shared.object3d import Object3D, encode_png, object_from_files
from trompe_shared.wavefront import Part, Surface, obj_text, parse_mtl, parse_surfaces

__all__ = ["complete", "read", "repaint", "shrunk"]


def read(upload: Upload, max_texture: int | None = None) -> Object3D:
    """The object of an OBJ and what is beside it. Raises ``ObjectError``."""
    return shrunk(_read(upload), max_texture)


def _read(upload: Upload) -> Object3D:
    files = upload.flat()
    return object_from_files(files if any(name.endswith("_mat_def.json") for name in files) else complete(files))


def repaint(upload: Upload, painted: Object3D) -> Upload:
    """``upload`` with the textures of ``painted``; what the OBJ lacked, it has now. Raises ``ObjectError``."""
    original = _read(upload)
    changed = repainted(original, painted)
    if not changed:
        return upload
    pngs = {name: with_alpha_of(rgb, decode(original.files[name], name)[1]) for name, rgb in changed.items()}
    return upload.with_flat({**original.files, **pngs})


def shrunk(obj: Object3D, side: int | None) -> Object3D:
    """``obj`` with no map larger than ``side``; its albedos are PNGs then, whatever they were."""
    files = dict(obj.files)
    maps = {name for m in obj.materials.values() for name in (m.albedo, m.normal, m.metallic) if name is not None}
    for name in maps:
        rgb, alpha = decode(files[name], name)
        small = shrink(rgb, side)
        if small is not rgb:
            files[name] = encode_png(small) if alpha is None else with_alpha_of(small, shrink(alpha, side))
    return obj if files == obj.files else object_from_files(files)


def complete(files: Mapping[str, bytes]) -> dict[str, bytes]:
    """``files`` of an OBJ, with a texture for each material that has a colour alone, and UVs for each mesh without.

    Where nothing is missing they are as they were. An MTL gets the lines it needs; an OBJ that has to be changed is
    written anew.
    """
    mesh = next(name for name in files if name.lower().endswith(".obj"))
    libraries = {name: data.decode("utf-8", "replace") for name, data in files.items() if name.lower().endswith(".mtl")}
    surfaces = parse_surfaces(files[mesh].decode("utf-8", "replace"), mesh)
    return _Completion(mesh, dict(files), libraries, surfaces).files_of()


class _Completion:
    def __init__(
        self, mesh: str, files: dict[str, bytes], libraries: dict[str, str], surfaces: Sequence[Surface]
    ) -> None:
        self._mesh, self._files, self._libraries, self._surfaces = mesh, files, libraries, surfaces
        self._library = next(iter(libraries), f"{mesh[:-4]}.mtl")
        self._parts: list[Part] = []
        self._rewritten = not libraries

    def files_of(self) -> dict[str, bytes]:
        """The files, with what was missing."""
        if not self._libraries:
            self._surfaces = [_renamed(surface) for surface in self._surfaces]
            names = dict.fromkeys(surface.material for surface in self._surfaces)
            self._libraries = {self._library: "".join(f"newmtl {name}\n" for name in names)}
        texts = dict(self._libraries)
        for surface in self._surfaces:
            self._add(surface)
        changed = {name: text.encode() for name, text in self._libraries.items() if text != texts[name]}
        if self._rewritten:
            changed |= {name: text.encode() for name, text in self._libraries.items()}
            changed[self._mesh] = obj_text(tuple(self._parts), library=self._library).encode()
        return self._files | changed

    def _add(self, surface: Surface) -> None:
        maps = {name: found for text in self._libraries.values() for name, found in parse_mtl(text).items()}
        if surface.material not in maps:
            raise ObjectError(
                f"{self._mesh!r} uses the material {surface.material!r}, which is not defined; the .mtl defines "
                f"{sorted(maps) or 'none'}."
            )
        if "albedo" in maps[surface.material]:
            self._keep(surface)
            return
        painted = painted_flat([surface], self._colour(surface))
        self._rewritten |= surface.uvs is None or surface.colours is not None
        self._parts += painted.parts
        name = free_name(f"{safe_name(surface.material)}_albedo.png", self._files)
        self._files[name] = encode_png(painted.picture)
        self._libraries = {k: _with_map(text, surface.material, name) for k, text in self._libraries.items()}

    def _keep(self, surface: Surface) -> None:
        if surface.uvs is None:
            raise ObjectError(
                f"{self._mesh!r}, material {surface.material!r}: it has a texture, but faces without texture "
                "coordinates (vt); unwrap the mesh in a modelling program."
            )
        self._parts.append(Part(surface.material, surface.vertices, surface.normals, surface.uvs, surface.faces))

    def _colour(self, surface: Surface) -> Sequence[float]:
        """Linear colour that the MTL gives a material; white where its vertices have colours of their own."""
        if surface.colours is not None:
            return (1.0, 1.0, 1.0)
        for text in self._libraries.values():
            for material, line in _lines(text):
                if material == surface.material and line.split(maxsplit=1)[:1] == ["Kd"]:
                    return _numbers(line, surface.material)
        return DEFAULT_COLOUR


def _renamed(surface: Surface) -> Surface:
    return replace(surface, material=safe_name(surface.material, default="default"))


def _lines(text: str) -> Iterator[tuple[str | None, str]]:
    """Each line of an MTL with the material that it is about."""
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
            f"Material {material!r}: {line.strip()[:60]!r} is no colour; expected Kd and three numbers."
        ) from error
    return red, green, blue


def _with_map(text: str, material: str, name: str) -> str:
    """An MTL in which ``material`` has the texture ``name`` instead of a colour."""
    lines = []
    for current, line in _lines(text if text.endswith("\n") else text + "\n"):
        word = next(iter(line.split(maxsplit=1)), "")
        lines.append("Kd 1 1 1\n" if (current, word) == (material, "Kd") else line)
        if (current, word) == (material, "newmtl"):
            lines.append(f"map_Kd {name}\n")
    return "".join(lines)
