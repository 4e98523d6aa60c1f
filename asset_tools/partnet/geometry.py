"""Read the faces of the shapes of a model: mesh files and primitives.

Unusable shapes are skipped and noted.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from urllib.parse import unquote

import numpy as np
import trimesh

from asset_tools.partnet.obj import GREY, Faces, Material, has_area, read_obj
from asset_tools.partnet.urdf import SIZES, URDF, Shape, Visual
from asset_tools.readers.exchange import read_exchange
from asset_tools.readers.files import ModelFiles
from robocas_ms3.core.errors import AssetError

Array = np.ndarray

MOST_TRIANGLES = 3_000_000  # of a model: 0.4 GB
FORMATS = (".obj", ".stl")  # for other formats, URDF readers disagree about the up axis
SCHEMES = ("package://", "model://")
SIDES = 32  # of a cylinder


class GeometryReader:
    """Reader of the shapes of one model, which reads each mesh file once.

    Args:
        folder: folder of the model; files outside of this folder are not read.
    """

    def __init__(self, folder: Path) -> None:
        self.files = ModelFiles(folder, folder)
        self.repairs: list[str] = self.files.notes
        self._read: dict[tuple[Path, tuple[float, float, float] | None], list[Faces]] = {}
        self._left = MOST_TRIANGLES

    def check_files(self, link: str, visuals: Sequence[Visual]) -> None:
        """Check that the mesh files of a link exist; the files are not read.

        Args:
            link: name of the link, for errors; empty: the fixed body.
            visuals: shapes of the link.

        Raises:
            AssetError: most files are missing, or a file is outside of the folder or has an unsupported format.
        """
        self._check_most(link, [self._missing(one.shape) for one in visuals])

    def read_faces(self, link: str, visuals: Sequence[Visual]) -> list[tuple[str, str, Faces]]:
        """Read the shapes of a link; return tuples of part name, file name and faces in the furniture's frame.

        Args:
            link: name of the link, for errors; empty: the fixed body.
            visuals: shapes of the link.

        Raises:
            AssetError: a file cannot be read, or most of the shapes are unusable.
        """
        found: list[tuple[str, str, Faces]] = []
        reasons = []
        for index, visual in enumerate(visuals):
            reason = self._missing(visual.shape)
            shown = [] if reason else self._faces(visual)
            if not reason and not shown:
                reason = f"{visual.shape.filename} has no faces"
            reasons.append(reason)
            self._left -= sum(len(faces.corners) for faces in shown)
            if self._left < 0:
                where, expected = self.files.root / URDF, f"at most {MOST_TRIANGLES:,} triangles"
                fix = "Reduce the number of faces of the meshes."
                raise AssetError("the model has too many triangles", where=where, expected=expected, fix=fix)
            turn, shift = visual.pose[:3, :3], visual.pose[:3, 3]
            source = visual.shape.filename or f"shape {index}"
            found += [(visual.part, source, replace(one, corners=one.corners @ turn.T + shift)) for one in shown]
        self._check_most(link, reasons)
        self.repairs += [f"skipped a shape of {link or 'the body'}: {reason}" for reason in reasons if reason]
        return found

    def _check_most(self, link: str, reasons: Sequence[str]) -> None:
        """Raise AssetError if more than half of the shapes of a link are unusable.

        Args:
            link: name of the link; empty: the fixed body.
            reasons: for each shape, why it is unusable; empty: usable.
        """
        lost = [reason for reason in reasons if reason]
        if len(lost) > len(reasons) / 2:
            what = f"most shapes of {f'the link {link}' if link else 'the fixed body'} are unusable"
            found = f"{len(lost)} unusable shapes of {len(reasons)}; the first: {lost[0]}"
            expected, fix = "at least half of the shapes", "Download the model again."
            raise AssetError(what, where=self.files.root / URDF, expected=expected, found=found, fix=fix)

    def _missing(self, shape: Shape) -> str:
        """Return the reason why a shape is unusable; empty if it is usable."""
        if shape.kind in SIZES:
            return ""
        if shape.kind != "mesh":
            return f"<{shape.kind}> is not a shape of URDF"
        path = self._path(shape)
        if path is None:
            return f"{shape.filename or 'a mesh without a file name'} is missing"
        if path.suffix.lower() not in FORMATS:
            expected, fix = " or ".join(FORMATS), "Convert it to OBJ, and use the OBJ in the URDF."
            raise AssetError("unsupported mesh format", where=path, expected=expected, found=path.suffix, fix=fix)
        return ""

    def _path(self, shape: Shape) -> Path | None:
        """Return the path of the mesh file of a shape, or None if it is missing.

        ``package://NAME/`` in a URDF is the subfolder NAME of the model if it exists, otherwise the model's folder.
        """
        name, root = shape.filename, self.files.root
        if name.startswith(SCHEMES):
            package, _, inside = unquote(name.partition("://")[2]).partition("/")
            name = f"{package}/{inside}" if (root / package).is_dir() else inside
        return self.files.find(name, root)

    def _faces(self, visual: Visual) -> list[Faces]:
        shape = visual.shape
        if shape.kind != "mesh":
            corners = _primitive(shape)
            return [Faces(corners, np.zeros((len(corners), 3, 2)), Material(visual.color or GREY))]
        path = self._path(shape)
        assert path is not None
        key = path, visual.color
        if key not in self._read:
            read = read_obj if path.suffix.lower() == ".obj" else _read_stl
            self._read[key] = read(path, self.files, visual.color)
        # a mirrored mesh would show its inside
        order = slice(None, None, -1 if np.prod(shape.size) < 0 else 1)
        return [
            replace(one, corners=(one.corners * shape.size)[:, order], uv=one.uv[:, order]) for one in self._read[key]
        ]


def _read_stl(path: Path, files: ModelFiles, color: tuple[float, float, float] | None) -> list[Faces]:
    corners = [part.vertices[part.faces] for part in read_exchange(path, files)]
    if not all(np.isfinite(one).all() for one in corners):
        raise AssetError("the mesh has NaN or infinite vertices", where=path, fix="Export the mesh again.")
    return [Faces(one, np.zeros((len(one), 3, 2)), Material(color or GREY)) for one in corners if has_area(one)]


def _primitive(shape: Shape) -> Array:
    if shape.kind == "box":
        body = trimesh.creation.box(shape.size)
    elif shape.kind == "cylinder":
        body = trimesh.creation.cylinder(shape.size[0], shape.size[1], SIDES)
    else:
        body = trimesh.creation.icosphere(2, shape.size[0])
    return np.asarray(body.triangles, float)
