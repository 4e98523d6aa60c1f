"""PartNet-Mobility's OBJ files with their materials; nothing is merged, both sides of a face may be there."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from robocas_ms3.errors import AssetError

Array = np.ndarray


@dataclass(frozen=True)
class Material:
    """How faces look.

    Attributes:
        color: (3,) 0 to 1.
        image: of the texture, which then is all there is to see; none: plain.
    """

    color: tuple[float, float, float] = (0.7, 0.7, 0.7)
    image: Path | None = None


@dataclass(frozen=True)
class Faces:
    """Triangles of one material.

    Attributes:
        corners: (F, 3, 3) m.
        uv: (F, 3, 2), v upward; zeros where the file has none.
        material: how they look.
    """

    corners: Array
    uv: Array
    material: Material


def read_obj(path: Path) -> list[Faces]:
    """Read a mesh; polygons become fans of triangles.

    Raises:
        AssetError: it can't be read, or has no faces.
    """
    points: list[list[float]] = []
    uvs: list[list[float]] = [[0.0, 0.0]]  # for corners that have none
    groups: dict[str, list[tuple[int, int]]] = {}
    materials: dict[str, Material] = {}
    current = groups.setdefault("", [])
    try:
        for line in path.read_text(encoding="utf-8", errors="replace").splitlines():
            head, _, rest = line.partition(" ")
            if head == "v":
                points.append([float(word) for word in rest.split()[:3]])
            elif head == "vt":
                uvs.append([float(word) for word in rest.split()[:2]])
            elif head == "f":
                corners = [_corner(word, len(points), len(uvs)) for word in rest.split()]
                for second, third in zip(corners[1:], corners[2:], strict=False):
                    current += [corners[0], second, third]
            elif head == "usemtl":
                current = groups.setdefault(rest.strip(), [])
            elif head == "mtllib":
                materials |= _read_materials(path.parent / rest.strip())
        places, spots = np.array(points, float).reshape(-1, 3), np.array(uvs, float)
        found = []
        for name, indices in groups.items():
            if indices:
                which = np.array(indices).reshape(-1, 3, 2)
                found.append(Faces(places[which[..., 0]], spots[which[..., 1]], materials.get(name, Material())))
    except (OSError, ValueError, IndexError) as error:
        raise AssetError("the mesh can't be read", where=path, found=error) from error
    if not found or not all(np.isfinite(faces.corners).all() for faces in found):
        raise AssetError("the mesh has no faces, or no finite ones", where=path)
    return found


def _corner(word: str, points: int, uvs: int) -> tuple[int, int]:
    numbers = word.split("/")
    point, uv = int(numbers[0]), int(numbers[1]) if len(numbers) > 1 and numbers[1] else 0
    if not 0 < point <= points and not 0 < -point <= points:
        raise ValueError(f"a face of vertex {point}, of {points}")
    # counted from 1, or back from the end
    return point - 1 if point > 0 else points + point, uv if uv >= 0 else uvs + uv


def _read_materials(path: Path) -> dict[str, Material]:
    """Materials of an MTL file by name; a missing file or image leaves the colour."""
    found: dict[str, Material] = {}
    name = ""
    if not path.is_file():
        return found
    for line in path.read_text(encoding="utf-8", errors="replace").splitlines():
        head, _, rest = line.strip().partition(" ")
        if head == "newmtl":
            name = rest.strip()
            found[name] = Material()
        elif head == "Kd" and name:
            red, green, blue = (float(word) for word in rest.split()[:3])
            found[name] = Material((red, green, blue), found[name].image)
        elif head == "map_Kd" and name:
            image = path.parent / rest.strip()
            found[name] = Material(found[name].color, image if image.is_file() else None)
    return found
