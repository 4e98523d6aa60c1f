"""Parse Wavefront OBJ and MTL files, including common deviations of exporters from the format."""

from __future__ import annotations

import re
from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from manifold3d import triangulate
from numpy.typing import NDArray

from robocas_ms3.core.errors import AssetError

Array = NDArray[np.float64]
Ints = NDArray[np.int64]

MOST_FACES = 1_000_000
MOST_VERTICES = 3_000_000
# options of map statements: with one argument, and with up to N numbers
FLAGS = {"-blendu", "-blendv", "-cc", "-clamp", "-imfchan", "-type", "-bm", "-boost", "-texres"}
VECTORS = {"-s": 3, "-o": 3, "-t": 3, "-mm": 2}


@dataclass
class MtlMaterial:
    """A material of an MTL file.

    Attributes:
        name: name in the file; several spaces become one.
        color: diffuse sRGB colour (``Kd``), 0 to 1; None: not in the file.
        emission: emitted sRGB colour (``Ke``), 0 to 1; None: not in the file.
        image: name of the colour texture (``map_Kd``, else ``map_Ka``); empty: none.
        emission_image: name of the emissive texture (``map_Ke``).
        uv_scale: factors of the UVs of the colour texture (``-s``).
        uv_offset: offsets of the UVs of the colour texture (``-o``), added after scaling.
        transparent: whether the material is transparent (``d``, ``Tr``, ``map_d``).
    """

    name: str
    color: tuple[float, float, float] | None = None
    emission: tuple[float, float, float] | None = None
    image: str = ""
    emission_image: str = ""
    uv_scale: tuple[float, float] = (1.0, 1.0)
    uv_offset: tuple[float, float] = (0.0, 0.0)
    transparent: bool = False


@dataclass
class ObjMesh:
    """The content of an OBJ file; polygons are split into triangles.

    Attributes:
        vertices: (V, 3) positions.
        colors: (V, 3) sRGB colours of the vertices, 0 to 1; None: no vertex has a colour.
        uvs: (T, 2) texture coordinates, v upward.
        normals: (N, 3) normals.
        faces: (F, 3) indices of ``vertices``.
        face_uvs: (F, 3) indices of ``uvs``, -1 if missing.
        face_normals: (F, 3) indices of ``normals``, -1 if missing.
        face_materials: (F,) indices of ``material_names``; -1: before the first ``usemtl``.
        material_names: names in ``usemtl`` lines; several spaces become one.
        libraries: text after ``mtllib`` of each such line: one file name with spaces, or several file names.
    """

    vertices: Array
    colors: Array | None
    uvs: Array
    normals: Array
    faces: Ints
    face_uvs: Ints
    face_normals: Ints
    face_materials: Ints
    material_names: list[str] = field(default_factory=list)
    libraries: list[str] = field(default_factory=list)


def decode_text(data: bytes) -> str:
    """Decode bytes as UTF-8, with or without a byte order mark.

    If the bytes are not valid UTF-8, decode them as Windows-1252.
    """
    try:
        return data.decode("utf-8-sig")
    except UnicodeDecodeError:
        return data.decode("cp1252", errors="replace")


def parse_mtl(text: str) -> dict[str, MtlMaterial]:
    """Parse an MTL file and return name -> material; invalid statements are ignored.

    Args:
        text: content of the file.
    """
    found: dict[str, MtlMaterial] = {}
    current: MtlMaterial | None = None
    ambient: dict[str, str] = {}
    for word, rest in _statements(text):
        key = word.lower()
        if key == "newmtl":
            current = MtlMaterial(" ".join(rest.split()))
            found[current.name] = current
        elif current is None:
            continue
        elif key == "kd":
            current.color = _color(rest)
        elif key == "ke":
            current.emission = _color(rest)
        elif key == "map_kd":
            current.image, current.uv_scale, current.uv_offset = _map(rest)
        elif key in ("d", "tr"):
            opaque = 1.0 if key == "d" else 0.0
            last = rest.split()[-1]
            current.transparent |= _is_number(last) and float(last) != opaque
        elif key == "map_d":
            current.transparent = True
        elif key == "map_ka":
            ambient[current.name] = _map(rest)[0]
        elif key == "map_ke":
            current.emission_image = _map(rest)[0]
    for name, image in ambient.items():
        found[name].image = found[name].image or image
    return found


def find_material(name: str, materials: dict[str, MtlMaterial]) -> MtlMaterial | None:
    """Return the material with a name.

    If there is none, return the material whose name differs only in letter case.
    """
    if name in materials:
        return materials[name]
    alike = [material for other, material in materials.items() if other.casefold() == name.casefold()]
    return alike[0] if alike else None


def parse_obj(text: str, where: object) -> ObjMesh:
    """Parse an OBJ file.

    Args:
        text: content of the file.
        where: path of the file, for errors.

    Raises:
        AssetError: a number or an index is invalid, or the file has too many faces or vertices.
    """
    points: list[str] = []
    uvs: list[str] = []
    normals: list[str] = []
    rows = {"v": points, "vt": uvs, "vn": normals}
    corners: list[tuple[int, int, int]] = []
    counts: list[int] = []  # corners per polygon
    polygon_materials: list[int] = []
    names: dict[str, int] = {}
    libraries: list[str] = []
    material = -1
    known: dict[str, tuple[int, int, int]] = {}
    try:
        for key, rest in _statements(text):
            if key in rows:
                rows[key].append(rest.partition("#")[0])
                if len(rows[key]) > MOST_VERTICES:
                    raise _too_many("vertices", MOST_VERTICES, where)
            elif key == "f":
                words = rest.partition("#")[0].split()
                if len(words) < 3:
                    continue
                for word in words:
                    corner = known.get(word)
                    if corner is None:
                        corner = _corner(word, len(points), len(uvs), len(normals))
                        if "-" not in word:  # negative indices are relative to the current line
                            known[word] = corner
                    corners.append(corner)
                counts.append(len(words))
                polygon_materials.append(material)
                if len(corners) > 4 * MOST_FACES:
                    raise _too_many("faces", MOST_FACES, where)
            elif key == "usemtl":
                material = names.setdefault(" ".join(rest.split()), len(names))
            elif key == "mtllib":
                libraries.append(rest.strip())
        vertices = _numbers(points, 3)
        colors = _colors(points)
        triangles, source = _fans(np.array(counts, np.int64))
        if len(triangles) > MOST_FACES:
            raise _too_many("faces", MOST_FACES, where)
        table = np.array(corners, np.int64).reshape(-1, 3)
        kinds = ("vertex (v)", "texture coordinate (vt)", "normal (vn)")
        for column, count, what in zip(table.T, (len(points), len(uvs), len(normals)), kinds, strict=True):
            if len(column) and (column.max() >= count or column.min() < -1):
                raise ValueError(f"a face refers to {what} {int(column.max()) + 1}, but the file has only {count}")
        if len(table) and table[:, 0].min() < 0:
            raise ValueError("a face refers to vertex (v) 0, but indices start at 1")
        triangles = _with_concave(triangles, source, np.array(counts, np.int64), vertices[table[:, 0]])
        return ObjMesh(
            vertices,
            colors,
            _numbers(uvs, 2, fill=0.0),
            _numbers(normals, 3),
            table[triangles, 0],
            table[triangles, 1],
            table[triangles, 2],
            np.array(polygon_materials, np.int64)[source],
            list(names),
            libraries,
        )
    except (ValueError, IndexError, OverflowError) as error:
        fix = "Export the mesh again."
        raise AssetError("cannot read this mesh", where=where, found=error, fix=fix) from error


def _statements(text: str) -> Iterator[tuple[str, str]]:
    """Yield the keyword and the rest of each line; comments are skipped, and continued lines are joined."""
    # an iterator, since a list of lines needs ten times the memory of the text
    for line in re.finditer(r"[^\r\n]+", re.sub(r"\\\r?\n", " ", text)):
        words = line[0].split(None, 1)
        if len(words) == 2 and not words[0].startswith("#"):
            yield words[0], words[1].rstrip()


def _corner(word: str, points: int, uvs: int, normals: int) -> tuple[int, int, int]:
    """Parse the corner ``v/vt/vn`` of a face: return three indices that start at 0.

    A missing index is -1.

    Args:
        word: text of the corner.
        points: number of vertices so far, to which a negative index is relative.
        uvs: number of texture coordinates so far.
        normals: number of normals so far.
    """
    parts = (word.split("/") + ["", ""])[:3]
    index = [int(part) if part else 0 for part in parts]
    counts = (points, uvs, normals)
    if not index[0] or any(-value > count for value, count in zip(index, counts, strict=True)):
        raise ValueError(f"a face refers to {word}, but only {points} vertices precede the face")
    first, second, third = (
        value - 1 if value >= 0 else count + value for value, count in zip(index, counts, strict=True)
    )
    return first, second, third


def _fans(counts: Ints) -> tuple[Ints, Ints]:
    """Split polygons into fans of triangles.

    Args:
        counts: (P,) number of corners of each polygon.

    Returns:
        Triangles (F, 3) as indices of corners, and the polygon (F,) of each triangle.
    """
    starts = np.cumsum(counts) - counts
    many = counts - 2
    source = np.repeat(np.arange(len(counts)), many)
    step = np.arange(len(source)) - np.repeat(np.cumsum(many) - many, many)
    first = starts[source]
    return np.column_stack([first, first + step + 1, first + step + 2]), source


def _with_concave(triangles: Ints, source: Ints, counts: Ints, points: Array) -> Ints:
    """Replace the fans of concave polygons by triangles inside the polygon; return triangles (F, 3).

    Args:
        triangles: (F, 3) triangles of the fans as indices of corners.
        source: (F,) polygon of each triangle.
        counts: (P,) number of corners of each polygon.
        points: (C, 3) positions of the corners.
    """
    if (counts <= 3).all():
        return triangles
    corners = points[triangles]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    sums = np.stack([np.bincount(source, axis, len(counts)) for axis in normals.T], axis=1)
    backwards = np.einsum("fi,fi->f", normals, sums[source]) < -1e-6 * (sums[source] ** 2).sum(axis=1)
    starts, first = np.cumsum(counts) - counts, np.cumsum(counts - 2) - (counts - 2)
    triangles = triangles.copy()
    for polygon in np.unique(source[backwards]).tolist():
        normal = sums[polygon] / np.linalg.norm(sums[polygon])
        across = np.cross(normal, np.eye(3)[np.abs(normal).argmin()])
        plane = np.stack([across, np.cross(normal, across)], axis=1)
        own = int(starts[polygon]) + np.arange(int(counts[polygon]))
        outline: Any = points[own] @ plane
        ears = np.asarray(triangulate([outline]), np.int64)
        if len(ears) == counts[polygon] - 2:  # otherwise the polygon intersects itself
            triangles[first[polygon] : first[polygon] + len(ears)] = own[ears]
    return triangles


def _numbers(rows: list[str], columns: int, fill: float | None = None) -> Array:
    """Parse rows of numbers and return the first ``columns`` numbers of each row (R, columns).

    Args:
        rows: text of each row.
        columns: number of columns.
        fill: value for missing numbers; None: a missing number is an error.
    """
    found = np.empty((len(rows), columns))
    for start in range(0, len(rows), 100_000):  # in chunks, since words need much more memory than numbers
        words = [row.split() for row in rows[start : start + 100_000]]
        if fill is not None:
            words = [line + [str(fill)] * (columns - len(line)) for line in words]
        if any(len(line) < columns for line in words):
            raise ValueError(f"a vertex (v) or normal (vn) has fewer than {columns} numbers")
        found[start : start + len(words)] = np.array([line[:columns] for line in words], dtype=float)
    return found


def _colors(rows: list[str]) -> Array | None:
    """Return the colours (V, 3) in 0..1 of vertices "x y z r g b", or None.

    The result is None if the first, the middle and the last vertex have no colour. A vertex without a colour is white.
    """
    if len(rows) == 0 or not any(len(row.split()) in (6, 7) for row in (rows[0], rows[len(rows) // 2], rows[-1])):
        return None
    words = [row.split()[3:6] for row in rows]
    found = np.array([line if len(line) == 3 else ("nan",) * 3 for line in words], dtype=float)
    top = 255.0 if np.nanmax(found) > 1 else 1.0
    return np.where(np.isnan(found), 1.0, found / top)


def _color(rest: str) -> tuple[float, float, float] | None:
    try:
        values = [min(max(float(word), 0.0), 1.0) for word in rest.split()[:3]]
    except ValueError:
        return None
    if len(values) == 1:
        values *= 3
    if len(values) != 3 or not np.isfinite(values).all():
        return None
    return values[0], values[1], values[2]


def _map(rest: str) -> tuple[str, tuple[float, float], tuple[float, float]]:
    """Parse a map statement of an MTL file.

    Return the file name, which may have spaces, and UV scale and offset.
    """
    vectors: dict[str, list[float]] = {}
    left = rest.strip()
    while left.startswith("-"):
        option, *tail = left.split(None, 1)
        option, left = option.lower(), tail[0] if tail else ""
        if option not in FLAGS and option not in VECTORS:
            return rest.strip(), (1.0, 1.0), (0.0, 0.0)
        count = VECTORS.get(option, 1)
        values: list[str] = []
        while left and len(values) < count:
            word, *tail = left.split(None, 1)
            if option in VECTORS and not _is_number(word):
                break
            values.append(word)
            left = tail[0] if tail else ""
        vectors[option] = [float(word) for word in values if _is_number(word)]
    scale, offset = (vectors.get(option, []) for option in ("-s", "-o"))
    return left, _pair(scale, 1.0), _pair(offset, 0.0)


def _is_number(word: str) -> bool:
    try:
        float(word)
    except ValueError:
        return False
    return True


def _pair(values: list[float], default: float) -> tuple[float, float]:
    found = [value if np.isfinite(value) else default for value in values] + [default, default]
    return found[0], found[1]


def _too_many(what: str, limit: int, where: object) -> AssetError:
    expected, fix = f"at most {limit:,}", "Reduce the mesh."
    return AssetError(f"the mesh has too many {what}", where=where, expected=expected, fix=fix)
