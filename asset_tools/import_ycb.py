"""Import the YCB objects that ManiSkill downloads.

ManiSkill's folder has ``info_pick_v0.json``, which maps the name of a model to its scale and more, and
``models/<name>/textured.obj``. Its ``collision.ply`` is not used; new hulls are computed.
"""

from __future__ import annotations

import os
import re
from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import Any

from asset_tools.build import build_object
from asset_tools.graspnet.catalogue import ENTRIES, NUMBERS
from asset_tools.import_scans import estimate_mass, make_object_id
from asset_tools.inspection import Inspect, Inspection, ModelSource, inspect_models
from asset_tools.pipeline import AssetJob, compute_content_hash, make_failing_job
from asset_tools.prepare import prepare_scan
from asset_tools.sources import ObjectSource
from robocas_ms3.assets.manifest import ObjectAsset
from robocas_ms3.core.documents import load_json
from robocas_ms3.core.errors import AssetError
from robocas_ms3.core.strict_model import check_name

INFO, MODELS = "info_pick_v0.json", "models"
DOWNLOAD = "Run `python -m mani_skill.utils.download_asset ycb`, or pass the folder that contains the download."
LICENCE = "CC BY 4.0"
ATTRIBUTION = "YCB Object and Model Set (B. Calli et al., 2015), as prepared by ManiSkill"

# kg, from the authors of the set; the catalogue of GraspNet-1Billion has the masses of its objects
MASSES = {
    "master_chef_can": 0.414,
    "cracker_box": 0.411,
    "tuna_fish_can": 0.171,
    "pudding_box": 0.187,
    "gelatin_box": 0.097,
    "strawberry": 0.018,
    "pitcher_base": 0.178,
    "bleach_cleanser": 1.131,
    "windex_bottle": 1.022,
    "bowl": 0.147,
    "sponge": 0.0062,
    "skillet_lid": 0.652,
    "plate": 0.279,
    "fork": 0.034,
    "spoon": 0.030,
    "knife": 0.031,
    "spatula": 0.0515,
    "wood_block": 0.729,
    "large_marker": 0.0158,
    "adjustable_wrench": 0.252,
    "phillips_screwdriver": 0.097,
    "hammer": 0.665,
    "medium_clamp": 0.059,
    "large_clamp": 0.125,
    "extra_large_clamp": 0.202,
    "mini_soccer_ball": 0.123,
    "softball": 0.191,
    "baseball": 0.148,
    "tennis_ball": 0.058,
    "golf_ball": 0.046,
    "chain": 0.098,
    "foam_brick": 0.028,
    "dice": 0.0052,
}
HOLLOW = re.compile(r"bowl|cups|pitcher|plate|skillet|fork|spoon|knife|spatula|clamp|chain|wrench|toy_airplane")


def default_ycb_folder() -> Path:
    """Return the folder to which ManiSkill downloads the YCB objects."""
    data = Path(os.environ.get("MS_ASSET_DIR") or Path.home() / ".maniskill") / "data"
    return data / "assets" / "mani_skill2_ycb"


def make_ycb_jobs(
    root: Path | None = None, ids: Sequence[str] = (), inspect: Inspect = inspect_models
) -> list[AssetJob]:
    """Return one job per YCB object; the job of an unreadable model raises an error when it runs.

    Args:
        root: ManiSkill's YCB folder; None: the default folder of the download.
        ids: names of YCB models, such as ``005_tomato_soup_can``; empty: all.
        inspect: function that inspects all models: `inspect_models` with chosen options.

    Raises:
        AssetError: the folder or a model is missing, or a name is unknown.
    """
    root = root or default_ycb_folder()
    info = _info(root)
    unknown = sorted(set(ids) - set(info))
    if unknown:
        raise AssetError(
            "unknown names of YCB objects",
            where=root / INFO,
            expected=f"names such as {min(info)}",
            found=_listed(unknown),
            fix="The names are the keys of this file.",
            usage=True,
        )
    models = sorted(set(ids) or info)
    missing = [model for model in models if not _mesh(root, model).is_file()]
    if missing:
        raise AssetError("models of YCB objects are missing", where=root / MODELS, found=_listed(missing), fix=DOWNLOAD)
    inspected = inspect({model: ModelSource((_mesh(root, model),), root) for model in models})
    return [_job(root, model, info[model], inspected[model]) for model in models]


def load_ycb_source(root: Path, model: str) -> ObjectSource:
    """Load a YCB object as the source of an asset, in metres with z up.

    Args:
        root: ManiSkill's YCB folder.
        model: name of the model, such as ``005_tomato_soup_can``.

    Raises:
        AssetError: the model is missing or damaged, or cannot be closed.
    """
    info = _info(root)
    if model not in info:
        expected = f"a name such as {min(info)}"
        raise AssetError("unknown name of a YCB object", where=root / INFO, expected=expected, found=model)
    scan = prepare_scan(_mesh(root, model), root=root, up="z", unit="m")
    scale = _scale(root, model, info[model])
    if scale != 1:
        scan.mesh.apply_scale(scale)
        scan.closed.apply_scale(scale)
    id_ = make_ycb_object_id(model)
    entry = ENTRIES[NUMBERS[id_]] if id_ in NUMBERS else None
    return ObjectSource(
        id=id_,
        name=entry.name if entry else id_.replace("_", " "),
        category=entry.category if entry else "ycb",
        mesh=scan.mesh,
        closed=scan.closed,
        mass=(entry.mass if entry else MASSES.get(id_)) or estimate_mass(scan.closed),
        source="ycb",
        licence=LICENCE,
        attribution=ATTRIBUTION,
        repairs=scan.repairs,
        graspnet_id=entry.number if entry else None,
        hollow=entry.hollow if entry else HOLLOW.search(id_) is not None,
    )


def make_ycb_object_id(model: str) -> str:
    """Convert the name of a YCB model to an object id: 072-a_toy_airplane -> toy_airplane_a.

    If the object is also in GraspNet-1Billion, the result is its id there.
    """
    found = re.fullmatch(r"\d+(?:-([a-z]))?_(\w+)", model)
    if found is None:
        return make_object_id(model)
    letter, name = found.groups()
    return make_object_id(f"{name}_{letter}" if letter else name)


def _job(root: Path, model: str, info: dict[str, Any], inspected: Inspection) -> AssetJob:
    if inspected.error is not None:
        return make_failing_job(make_ycb_object_id(model), inspected.error)
    try:
        scale = _scale(root, model, info)
    except AssetError as error:
        return make_failing_job(make_ycb_object_id(model), error)
    content = compute_content_hash("ycb", model, scale, files=inspected.files, packages=["graspnet"])
    return AssetJob(make_ycb_object_id(model), partial(_make, root, model), content)


def _mesh(root: Path, model: str) -> Path:
    return root / MODELS / model / "textured.obj"


def _make(root: Path, model: str, folder: Path) -> ObjectAsset:
    return build_object(load_ycb_source(root, model), folder)


def _info(root: Path) -> dict[str, dict[str, Any]]:
    path = root / INFO
    if not path.is_file():
        raise AssetError("ManiSkill's YCB objects are missing", where=root, expected=INFO, fix=DOWNLOAD)
    try:
        info = load_json(path)
    except ValueError as error:
        raise AssetError("cannot read the list of YCB objects", where=path, found=error, fix=DOWNLOAD) from error
    if not isinstance(info, dict) or not info or not all(isinstance(entry, dict) for entry in info.values()):
        expected, found = "a mapping of names to properties", type(info).__name__
        raise AssetError("invalid list of YCB objects", where=path, expected=expected, found=found, fix=DOWNLOAD)
    for name in info:
        check_name(name, AssetError, where=path, fix=DOWNLOAD)
    return info


def _scale(root: Path, model: str, info: dict[str, Any]) -> float:
    scales = info.get("scales", [1.0])
    try:
        scale = float(scales[0])
    except (TypeError, ValueError, LookupError) as error:
        found, expected = f"scales {scales} of {model}", "a list that starts with a positive number"
        raise AssetError("invalid scale of a YCB object", where=root / INFO, expected=expected, found=found) from error
    if not 0 < scale < float("inf"):
        found = f"scale {scale} of {model}"
        raise AssetError("invalid scale of a YCB object", where=root / INFO, expected="a positive number", found=found)
    return scale


def _listed(names: Sequence[str]) -> str:
    return ", ".join(names)
