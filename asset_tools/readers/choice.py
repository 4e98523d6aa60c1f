"""Choose the mesh files of a folder that form one object: the best version, or all parts."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np
import trimesh
from numpy.typing import NDArray
from scipy.spatial import ConvexHull, KDTree, QhullError

from asset_tools.readers.files import TEXTURE_FOLDERS
from asset_tools.readers.surface import MeshPart
from robocas_ms3.core.errors import AssetError

Array = NDArray[np.float64]

FORMATS = (".obj", ".glb", ".gltf", ".ply", ".stl", ".off", ".dae", ".3mf")  # in order of preference
_WORD = r"(^|[^a-z])({})([^a-z]|$)"
COLLISION = re.compile(_WORD.format("collisions?|collider|coll?|vhacd|coacd|ucx|ubx|usp|cvx|decomp|decomposed"))
HULL = re.compile(_WORD.format("convex|hulls?|physics|phys"))  # may also be a part of a boat
# suffixes of versions of one mesh
QUALIFIERS = re.compile(
    r"[^a-z0-9]*(non[^a-z0-9]*textured|untextured|textured?|tex|visual|lod[^a-z]*\d*|low|high|simplified)$"
)
PREFERRED_FOLDER = "google_16k"  # in the YCB set; its other folders have the same mesh, larger or from other methods
COLLISION_FOLDERS = {"collision", "collisions", "coacd", "vhacd"}
DEPTH = 3  # levels of subfolders that are searched for meshes
MOST_FILES = 64
ENOUGH_FACES = 20_000  # above this number, more faces are not preferred
SAME = 0.02  # of the diagonal: tolerance for equal surfaces and bounding boxes
COVERED = 0.9  # fraction of a surface that must be on another one to be contained in it
APART = 0.05  # of the diagonal: largest gap between parts of one object
INSIDE = 0.05  # fraction of a part in the hull of another; above, they are two objects around one axis
MOST_OF = 0.6  # of a hull's diagonal: minimum size of the other meshes
SCALES = (1.0, 10.0, 100.0, 1000.0, 25.4, 2.54, 39.37, 0.3937)  # between units
SAMPLES, TRIED = 20_000, 500  # points on a surface, and number of points compared with another surface


@dataclass(frozen=True, eq=False)
class Candidate:
    """A mesh file that may be the whole object, or a part of the object.

    Attributes:
        path: path of the file.
        parts: triangles of the file, one element per material.
    """

    path: Path
    parts: list[MeshPart]

    @cached_property
    def bounds(self) -> Array:
        """Bounding box (2, 3) of all faces: lower and upper corner."""
        return np.array([self.samples.min(axis=0), self.samples.max(axis=0)])

    @cached_property
    def diagonal(self) -> float:
        """Length of the bounding box's diagonal."""
        return float(np.linalg.norm(self.bounds[1] - self.bounds[0]))

    @cached_property
    def textured(self) -> bool:
        """Whether the mesh has a texture image."""
        return any(part.uvs is not None and part.material.image is not None for part in self.parts)

    @property
    def sort_key(self) -> tuple[bool, bool, int, int, str]:
        """Key to sort candidates, best first: textured, coloured, many faces, preferred format, name."""
        coloured = any(part.colors is not None or part.material.color != (1.0, 1.0, 1.0) for part in self.parts)
        faces, suffix = sum(len(part.faces) for part in self.parts), self.path.suffix.lower()
        return not self.textured, not coloured, -min(faces, ENOUGH_FACES), FORMATS.index(suffix), self.path.name

    @cached_property
    def samples(self) -> Array:
        """Points (N, 3) on the surface: 20,000 random points and the extreme vertices."""
        offsets = np.cumsum([0] + [len(part.vertices) for part in self.parts[:-1]])
        vertices = np.concatenate([part.vertices for part in self.parts])
        faces = np.concatenate([part.faces + offset for part, offset in zip(self.parts, offsets, strict=True)])
        mesh = trimesh.Trimesh(vertices, faces, process=False)
        spread = np.asarray(trimesh.sample.sample_surface(mesh, SAMPLES, seed=0)[0])
        used = vertices[np.unique(faces)]
        ends = np.concatenate([used[used.argmin(axis=0)], used[used.argmax(axis=0)]])
        return np.concatenate([spread, ends])

    @cached_property
    def tree(self) -> KDTree:
        """KD tree of `samples`."""
        return KDTree(self.samples)

    def contains(self, points: Array) -> bool:
        """Return whether at least 90 % of points (N, 3) are on the surface, within 2 % of the diagonal."""
        reach = SAME * self.diagonal
        near = ((points >= self.bounds[0] - reach) & (points <= self.bounds[1] + reach)).all(axis=1)
        if near.mean() < COVERED:
            return False
        return bool((self.tree.query(points, distance_upper_bound=reach)[0] <= reach).mean() >= COVERED)


def find_mesh_files(folder: Path) -> list[Path]:
    """Return the mesh files in the folder of an object and its subfolders, sorted by name.

    Raises:
        AssetError: the folder has no mesh files, or more than 64 that are not collision meshes.
    """
    found = _meshes_below(folder, DEPTH)
    if not found:
        others = sorted({path.suffix.lower() for path in folder.iterdir() if path.is_file()} - {""})
        fix = f"Export the mesh in one of {', '.join(FORMATS)}."
        found_types = f"files of type {', '.join(others)}" if others else "no files"
        raise AssetError("no mesh in this folder", where=folder, found=found_types, fix=fix)
    shown = [path for path in found if not is_collision_mesh(path, folder)]
    if len(shown) > MOST_FILES:
        fix, expected = "Use one folder per object, or join the parts into one file.", f"at most {MOST_FILES}"
        raise AssetError("too many mesh files", where=folder, expected=expected, found=len(shown), fix=fix)
    return found if shown else found[:MOST_FILES]


def is_mesh_file(path: Path) -> bool:
    """Return whether a path is a mesh file by its suffix; hidden files do not count."""
    return path.suffix.lower() in FORMATS and not path.name.startswith(".") and not path.is_dir()


def is_collision_mesh(path: Path, folder: Path) -> bool:
    """Return whether a file is a collision mesh by its name or by its subfolder of ``folder``."""
    folders = {part.lower() for part in path.relative_to(folder).parts[:-1]}
    return COLLISION.search(path.stem.lower()) is not None or bool(folders & COLLISION_FOLDERS)


def choose_candidates(candidates: Sequence[Candidate], folder: Path, notes: list[str]) -> list[Candidate]:
    """Return the candidates that together form the object.

    If several candidates are versions of one mesh, the most detailed version stays; textured versions come first. A
    candidate that another candidate contains is also ignored. The remaining candidates must be parts of one object,
    which touch each other.

    Args:
        candidates: meshes with faces; collision meshes only if there are no other meshes.
        folder: folder of the object.
        notes: list to which the function appends one note per used or ignored file.

    Raises:
        AssetError: several files do not look like parts of one object.
    """
    ignored: dict[Path, str] = {}
    left = _without_hulls(sorted(candidates, key=lambda one: one.sort_key), ignored)
    best: list[Candidate] = []
    for candidate in left:
        other = next((kept for kept in best if _are_versions(kept, candidate)), None)
        if other is None:
            best.append(candidate)
        else:
            ignored[candidate.path] = f"another version of {_name(other, folder)}"
    for candidate in list(best):
        points = candidate.samples[:TRIED]
        for other in best:
            if other is not candidate and (other.textured or not candidate.textured) and other.contains(points):
                ignored[candidate.path] = f"{_name(other, folder)} contains it"
                best.remove(candidate)
                break
    if len(best) > 1:
        _check_parts(best, folder)
        notes.append(f"joined the parts {', '.join(_name(part, folder) for part in best)}")
    elif ignored:
        notes.append(f"used {_name(best[0], folder)}")
    notes.extend(f"ignored {path.relative_to(folder).as_posix()}: {why}" for path, why in ignored.items())
    return best


def _meshes_below(folder: Path, depth: int) -> list[Path]:
    entries = sorted(path for path in folder.iterdir() if not path.name.startswith("."))
    folders = [path for path in entries if path.is_dir() and path.name.lower() not in {"__macosx", *TEXTURE_FOLDERS}]
    preferred = [path for path in folders if path.name.lower() == PREFERRED_FOLDER]
    found = [path for path in entries if is_mesh_file(path)]
    for path in preferred or folders:
        found += _meshes_below(path, depth - 1) if depth else []
    return found


def _without_hulls(candidates: list[Candidate], ignored: dict[Path, str]) -> list[Candidate]:
    """Return the candidates without collision hulls, recognised by their names.

    A hull stays if the other meshes together are smaller than 60 % of it, since then it may be a part of the object.

    Args:
        candidates: all candidates.
        ignored: path -> reason; the function adds the removed candidates.
    """
    hulls = [one for one in candidates if HULL.search(one.path.stem.lower())]
    others = [one for one in candidates if one not in hulls]
    if not hulls or not others:
        return candidates
    box = np.array([one.bounds for one in others])
    size = float(np.linalg.norm(box[:, 1].max(axis=0) - box[:, 0].min(axis=0)))
    small = [one for one in hulls if MOST_OF * one.diagonal <= size]
    ignored |= {one.path: "a collision mesh" for one in small}
    return [one for one in candidates if one not in small]


def _are_versions(first: Candidate, second: Candidate) -> bool:
    """Return whether two files are versions of one mesh, also with other units or up axes."""
    one, other = (_version_name(candidate.path) for candidate in (first, second))
    alike = one == other and first.path.parent == second.path.parent
    if alike and np.abs(first.bounds - second.bounds).max() <= SAME * first.diagonal:
        return True
    ratio = first.diagonal / max(second.diagonal, 1e-300)
    scale = next((s for s in (*SCALES, *(1 / s for s in SCALES)) if abs(np.log(ratio / s)) < SAME), None)
    if scale is None:
        return False
    turns = [np.eye(3)]
    if alike:  # y up in one and z up in the other
        turns += [np.array([[1, 0, 0], [0, 0, -1], [0, 1, 0]]), np.array([[1, 0, 0], [0, 0, 1], [0, -1, 0]])]
    return any(_same_surface(first, second, scale * turn) for turn in turns)


def _same_surface(first: Candidate, second: Candidate, transform: Array) -> bool:
    """Return whether ``second``, transformed by a matrix (3, 3), has the surface of ``first``."""
    if not first.contains(second.samples[:TRIED] @ transform.T):
        return False
    return second.contains(first.samples[:TRIED] @ np.linalg.inv(transform).T)


def _version_name(path: Path) -> str:
    stem = path.stem.lower()
    return QUALIFIERS.sub("", stem) or stem


def _check_parts(parts: Sequence[Candidate], folder: Path) -> None:
    """Check that files look like parts of one object.

    Raises:
        AssetError: the parts do not touch, or enclose each other around one axis like separate objects.
    """
    bounds = np.array([part.bounds for part in parts])
    diagonal = float(np.linalg.norm(bounds[:, 1].max(axis=0) - bounds[:, 0].min(axis=0)))
    joined, queue = {0}, [0]
    while queue:
        tree = parts[queue.pop()].tree
        for index in set(range(len(parts))) - joined:
            # parts touch along small areas: all samples of the smaller one count
            if tree.query(parts[index].samples, distance_upper_bound=APART * diagonal)[0].min() < np.inf:
                joined.add(index)
                queue.append(index)
    if len(joined) < len(parts) or (_around_one_axis(bounds, SAME * diagonal) and _inside(parts)):
        raise AssetError(
            "the mesh files are not parts of one object",
            where=folder,
            expected="files whose meshes touch each other and are not inside each other",
            found=", ".join(_name(part, folder) for part in parts),
            fix="Use one folder per object, or join the parts into one file.",
        )


def _around_one_axis(bounds: Array, tolerance: float) -> bool:
    """Return whether all bounding boxes (N, 2, 3) have equal centres, or equal base planes and axes.

    Args:
        bounds: (N, 2, 3) lower and upper corner of each box.
        tolerance: largest difference of coordinates that count as equal.
    """
    middles = bounds.mean(axis=1)
    apart = np.ptp(middles, axis=0) > tolerance
    bases_apart = np.ptp(bounds[:, 0], axis=0) > tolerance
    return not apart.any() or any(not bases_apart[axis] and not np.delete(apart, axis).any() for axis in range(3))


def _inside(parts: Sequence[Candidate]) -> bool:
    """Return whether more than 5 % of a part is inside the convex hull of another part."""
    for one in parts:
        try:
            planes = ConvexHull(one.samples).equations
        except QhullError:
            continue
        for other in parts:
            heights = (other.samples[:TRIED] @ planes[:, :3].T + planes[:, 3]).max(axis=1)
            if other is not one and (heights < -SAME * one.diagonal / 2).mean() > INSIDE:
                return True
    return False


def _name(candidate: Candidate, folder: Path) -> str:
    return candidate.path.relative_to(folder).as_posix()
