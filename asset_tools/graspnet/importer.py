"""Import GraspNet-1Billion: ``models/NNN`` and, if it exists, ``grasp_label/NNN_labels.npz``."""

from __future__ import annotations

import zlib
from collections.abc import Sequence
from functools import partial
from pathlib import Path

import numpy as np
import trimesh

from asset_tools.build import FEW_GRASPS, GRASPS, build_object
from asset_tools.graspnet.catalogue import COUNT, ENTRIES, find_catalogue_entry
from asset_tools.graspnet.labels import load_label_grasps, read_label_checksums
from asset_tools.grasps import Grasps, sample_grasps
from asset_tools.import_scans import estimate_mass
from asset_tools.inspection import Inspect, Inspection, ModelSource, inspect_models
from asset_tools.pipeline import AssetJob, compute_content_hash, make_failing_job
from asset_tools.prepare import prepare_scan
from asset_tools.sources import ObjectSource
from robocas_ms3.assets.manifest import ObjectAsset
from robocas_ms3.core.errors import AssetError

LICENCE = "CC BY-NC-SA 4.0"
ATTRIBUTION = "GraspNet-1Billion (H.-S. Fang, C. Wang, M. Gou, C. Lu, CVPR 2020)"


def make_graspnet_jobs(root: Path, ids: Sequence[int] = (), inspect: Inspect = inspect_models) -> list[AssetJob]:
    """Return one job per object of GraspNet-1Billion.

    The job of an unreadable model raises an error when it runs.

    Args:
        root: folder of the dataset, which contains ``models``.
        ids: numbers of objects; empty: the 46 objects of RoboCAS-v0.
        inspect: function that inspects all models: `inspect_models` with chosen options.

    Raises:
        AssetError: a number is invalid, or a model is missing.
    """
    numbers = sorted(set(ids)) or list(ENTRIES)
    unknown = [number for number in numbers if not 0 <= number < COUNT]
    if unknown:
        what = "unknown numbers of GraspNet-1Billion objects"
        raise AssetError(what, expected=f"numbers from 0 to {COUNT - 1}", found=_listed(unknown), usage=True)
    missing = [number for number in numbers if not _model(root, number).is_dir()]
    if missing:
        raise AssetError(
            "models of GraspNet-1Billion are missing",
            where=root,
            expected=f"a folder models/NNN for each of {len(numbers)} objects",
            found=f"no folder for the numbers {_listed(missing)}",
            fix="Pass the folder that contains models/, or select the objects that you have with --ids.",
        )
    models = {str(number): ModelSource((_mesh(root, number),), root) for number in numbers}
    inspected = inspect(models)
    return [_job(root, number, inspected[str(number)]) for number in numbers]


def load_graspnet_source(root: Path, number: int) -> ObjectSource:
    """Load an object of GraspNet-1Billion as the source of an asset.

    If the label file of the object exists, the source has grasps from this file. If fewer than 50 of these grasps fit
    the gripper, more grasps are sampled, with a note in ``repairs``. Models are in metres with z up. The source keeps
    the frame of the model, since the labels are given in this frame.

    Args:
        root: folder of the dataset.
        number: number of the object.

    Raises:
        AssetError: the model is missing, damaged or cannot be closed, or the label file is damaged.
    """
    entry = find_catalogue_entry(number)
    model = prepare_scan(_mesh(root, number), root=root, up="z", unit="m")
    grasps, notes = _grasps(_labels(root, number), model.closed, entry.id)
    return ObjectSource(
        id=entry.id,
        name=entry.name,
        category=entry.category,
        mesh=model.mesh,
        closed=model.closed,
        mass=entry.mass or estimate_mass(model.closed),
        source="graspnet",
        licence=LICENCE,
        attribution=ATTRIBUTION,
        repairs=(*model.repairs, *notes),
        graspnet_id=number,
        grasps=grasps,
        hollow=entry.hollow,
    )


def _grasps(labels: Path, closed: trimesh.Trimesh, id_: str) -> tuple[Grasps | None, tuple[str, ...]]:
    """Return the grasps of an object from its label file, and notes.

    Args:
        labels: path of the label file.
        closed: watertight mesh of the object, m.
        id_: id of the object, which is the seed of sampling.

    Returns:
        The labelled grasps that fit the gripper; if they are fewer than 50, with sampled grasps in addition. None if
        there is no label file.
        Notes on sampled grasps.
    """
    if not labels.is_file():
        return None, ()
    found, labelled = load_label_grasps(labels, closed)
    if len(found) >= FEW_GRASPS:
        return found, ()
    rng = np.random.default_rng(zlib.crc32(id_.encode()))
    sampled = sample_grasps(closed, np.asarray(closed.center_mass), rng, count=GRASPS - len(found))
    note = f"{len(found)} of {labelled} good grasp labels fit the gripper; sampled {len(sampled)} more grasps"
    return found.concatenate(sampled), (note,)


def _job(root: Path, number: int, inspected: Inspection) -> AssetJob:
    id_, labels = find_catalogue_entry(number).id, _labels(root, number)
    if inspected.error is not None:
        return make_failing_job(id_, inspected.error)
    try:
        checksums = read_label_checksums(labels) if labels.is_file() else ()
    except AssetError as error:
        return make_failing_job(id_, error)
    content = compute_content_hash("graspnet", number, checksums, files=inspected.files, packages=["graspnet"])
    return AssetJob(id_, partial(_make, root, number), content)


def _make(root: Path, number: int, folder: Path) -> ObjectAsset:
    return build_object(load_graspnet_source(root, number), folder)


def _model(root: Path, number: int) -> Path:
    return root / "models" / find_catalogue_entry(number).folder_name


def _mesh(root: Path, number: int) -> Path:
    """Return the path of ``textured.obj`` of a model.

    If this file is missing, return the path of the model's folder.
    """
    textured = _model(root, number) / "textured.obj"
    return textured if textured.is_file() else _model(root, number)


def _labels(root: Path, number: int) -> Path:
    return root / "grasp_label" / f"{find_catalogue_entry(number).folder_name}_labels.npz"


def _listed(numbers: Sequence[int]) -> str:
    return ", ".join(map(str, numbers))
