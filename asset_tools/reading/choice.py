"""Which files of a folder are the object: of several versions the best one, of several parts all of them."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import trimesh
from numpy.typing import NDArray
from scipy.spatial import KDTree

from asset_tools.reading.surface import Part
from robocas_ms3.errors import AssetError

Array = NDArray[np.float64]

FORMATS = (".obj", ".glb", ".gltf", ".ply", ".stl", ".off", ".dae", ".3mf")  # the better first
COLLISION = re.compile(r"(^|[^a-z])(collisions?|collider|coll?|vhacd|coacd|convex|hulls?|physics|phys)([^a-z]|$)")
# what the same mesh is called in other versions of it
QUALIFIERS = re.compile(
    r"[^a-z0-9]*(non[^a-z0-9]*textured|untextured|textured?|tex|visual|lod[^a-z]*\d*|low|high|simplified)$"
)
MESH_FOLDERS = ("google_16k", "meshes", "mesh", "visual", "visuals", "models", "model")  # known, the better first
OTHER_FOLDERS = {
    "textures",
    "texture",
    "materials",
    "images",
    "maps",
    "thumbnails",
    "__macosx",
    "collision",
    "collisions",
}
DEPTH = 3  # folders below the object's in which meshes are looked for
MOST_FILES = 64
ENOUGH_FACES = 20_000  # more detail is no reason to prefer a mesh
SAME = 0.02  # of the diagonal: distance of surfaces, and difference of boxes, of versions of one mesh
COVERED = 0.9  # share of a surface that has to lie on another's for the other to show it
APART = 0.05  # of the diagonal: gap between parts of one object at most
SCALES = (10.0, 100.0, 1000.0, 25.4, 2.54, 39.37, 0.3937)  # between units
SAMPLES = 20_000  # of a surface
TRIED = 500  # of them, whose distance to another surface is measured


@dataclass(frozen=True, eq=False)
class Candidate:
    """A mesh file that may be the object.

    Attributes:
        path: of the file.
        parts: what it holds.
    """

    path: Path
    parts: list[Part]

    @property
    def faces(self) -> int:
        """Number of triangles."""
        return sum(len(part.faces) for part in self.parts)

    @property
    def bounds(self) -> Array:
        """(2, 3) of all faces."""
        points = np.concatenate([part.vertices[np.unique(part.faces)] for part in self.parts])
        return np.array([points.min(axis=0), points.max(axis=0)])

    @property
    def rank(self) -> tuple[bool, bool, int, int, str]:
        """Sort key, the best first: textured, coloured, detailed, of a better format, by name."""
        textured = any(part.uvs is not None and part.material.image is not None for part in self.parts)
        coloured = any(part.colors is not None or part.material.color != (1.0, 1.0, 1.0) for part in self.parts)
        formats = FORMATS.index(self.path.suffix.lower())
        return not textured, not coloured, -min(self.faces, ENOUGH_FACES), formats, self.path.name

    def sample(self) -> Array:
        """Return points (N, 3) spread over the surface."""
        offsets = np.cumsum([0] + [len(part.vertices) for part in self.parts[:-1]])
        vertices = np.concatenate([part.vertices for part in self.parts])
        faces = np.concatenate([part.faces + offset for part, offset in zip(self.parts, offsets, strict=True)])
        mesh = trimesh.Trimesh(vertices, faces, process=False)
        return np.asarray(trimesh.sample.sample_surface(mesh, SAMPLES, seed=0)[0])


def mesh_files(folder: Path) -> tuple[list[Path], list[Path]]:
    """Return the mesh files that show an object, and those made for collision checking.

    They are looked for in the folder itself; where there are none, in the folders below, known names first.

    Raises:
        AssetError: there are none, or more than 64.
    """
    found = _meshes_of(folder, DEPTH)
    if not found:
        others = sorted({path.suffix.lower() for path in folder.iterdir() if path.is_file()} - {""})
        expected = f"a file that ends in {', '.join(FORMATS)}"
        raise AssetError("no mesh in this folder", where=folder, expected=expected, found=", ".join(others))
    collision = [path for path in found if is_collision(path)]
    if len(collision) == len(found):
        collision = []
    shown = [path for path in found if path not in collision]
    if len(shown) > MOST_FILES:
        fix = "Give each object a folder of its own, or its parts in one file."
        raise AssetError(
            "too many mesh files", where=folder, expected=f"at most {MOST_FILES}", found=len(shown), fix=fix
        )
    return shown, collision


def is_mesh(path: Path) -> bool:
    """Whether a file has a mesh format's suffix; hidden files have not."""
    return path.suffix.lower() in FORMATS and not path.name.startswith(".") and not path.is_dir()


def is_collision(path: Path) -> bool:
    """Whether the name of a file says that it was made for collision checking."""
    return COLLISION.search(path.stem.lower()) is not None


def choose(candidates: Sequence[Candidate], folder: Path, notes: list[str]) -> list[Candidate]:
    """Return the candidates that together are the object.

    Files of one name or one bounding box are versions of one mesh: the textured and most detailed one is taken. A file
    whose surface lies on another's is left out. The others are parts of one object if they touch each other.

    Args:
        candidates: all with faces.
        folder: that holds them.
        notes: gets a line that says which files were used and which were ignored.

    Raises:
        AssetError: several files that are neither versions nor touching parts, all named.
    """
    best: list[Candidate] = []
    ignored: dict[Path, str] = {}
    for candidate in sorted(candidates, key=lambda one: one.rank):
        other = next((kept for kept in best if _are_versions(kept, candidate)), None)
        if other is None:
            best.append(candidate)
        else:
            ignored[candidate.path] = f"another version of {_name(other, folder)}"
    if len(best) > 1:
        best = _uncovered(best, ignored, folder)
    if len(best) > 1:
        _check_parts(best, folder)
        notes.append(f"joined the parts {', '.join(_name(part, folder) for part in best)}")
    elif ignored:
        notes.append(f"used {_name(best[0], folder)}")
    notes.extend(f"ignored {path.relative_to(folder).as_posix()}: {why}" for path, why in ignored.items())
    return best


def version_name(path: Path) -> str:
    """Return a file's name without what tells versions of a mesh apart."""
    stem = path.stem.lower()
    return QUALIFIERS.sub("", stem) or stem


def _meshes_of(folder: Path, depth: int) -> list[Path]:
    entries = sorted(folder.iterdir())
    found = [path for path in entries if is_mesh(path)]
    if found or not depth:
        return found
    folders = [path for path in entries if path.is_dir() and not path.name.startswith(".")]
    folders = [path for path in folders if path.name.lower() not in OTHER_FOLDERS]
    known = [path for name in MESH_FOLDERS for path in folders if path.name.lower() == name]
    for path in known:
        found = _meshes_of(path, depth - 1)
        if found:
            return found
    return [mesh for path in folders if path not in known for mesh in _meshes_of(path, depth - 1)]


def _are_versions(first: Candidate, second: Candidate) -> bool:
    if version_name(first.path) == version_name(second.path):
        return True
    one, other = first.bounds, second.bounds
    diagonal = float(np.linalg.norm(one[1] - one[0]))
    if np.abs(one - other).max() <= SAME * diagonal:
        return True
    sizes, others = np.sort(np.ptp(one, axis=0)), np.sort(np.ptp(other, axis=0))
    ratio = float(np.linalg.norm(others) / max(np.linalg.norm(sizes), 1e-300))
    alike = np.allclose(others, ratio * sizes, atol=SAME * float(np.linalg.norm(others)))
    return alike and any(abs(np.log(ratio * scale)) < SAME or abs(np.log(ratio / scale)) < SAME for scale in SCALES)


def _uncovered(candidates: list[Candidate], ignored: dict[Path, str], folder: Path) -> list[Candidate]:
    """Return the candidates whose surface is not shown by another one."""
    largest = sorted(candidates, key=lambda one: -float(np.ptp(one.bounds, axis=0).prod()))
    kept: list[tuple[Candidate, KDTree, float]] = []
    for candidate in largest:
        points, diagonal = candidate.sample(), float(np.linalg.norm(np.ptp(candidate.bounds, axis=0)))
        for other, tree, size in kept:
            if (tree.query(points[:TRIED])[0] <= SAME * size).mean() >= COVERED:
                ignored[candidate.path] = f"its surface is part of {_name(other, folder)}"
                break
        else:
            kept.append((candidate, KDTree(points), diagonal))
    chosen = {id(candidate) for candidate, _, _ in kept}
    return [candidate for candidate in candidates if id(candidate) in chosen]


def _check_parts(parts: Sequence[Candidate], folder: Path) -> None:
    """Check that files look like parts of one object: they touch, and are not each an object of its own."""
    bounds = np.array([part.bounds for part in parts])
    whole = np.array([bounds[:, 0].min(axis=0), bounds[:, 1].max(axis=0)])
    diagonal = float(np.linalg.norm(whole[1] - whole[0]))
    trees = [KDTree(part.sample()) for part in parts]
    joined, queue = {0}, [0]
    while queue:
        tree = trees[queue.pop()]
        for other in set(range(len(parts))) - joined:
            if tree.query(trees[other].data, distance_upper_bound=APART * diagonal)[0].min() <= APART * diagonal:
                joined.add(other)
                queue.append(other)
    if len(joined) < len(parts) or _stand_alike(bounds, SAME * diagonal):
        raise AssetError(
            "several mesh files that are neither versions nor touching parts of one object",
            where=folder,
            expected="one object per folder",
            found=", ".join(_name(part, folder) for part in parts),
            fix="Give each object a folder of its own, or join the parts into one file.",
        )


def _stand_alike(bounds: Array, tolerance: float) -> bool:
    """Whether boxes (N, 2, 3) have one middle, or stand on one plane around one axis, as separate objects do."""
    middles = bounds.mean(axis=1)
    apart = np.ptp(middles, axis=0) > tolerance
    bases_apart = np.ptp(bounds[:, 0], axis=0) > tolerance
    return not apart.any() or any(not bases_apart[axis] and not np.delete(apart, axis).any() for axis in range(3))


def _name(candidate: Candidate, folder: Path) -> str:
    return candidate.path.relative_to(folder).as_posix()
