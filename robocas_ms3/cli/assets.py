"""``robocas assets``: build and import packs; `assets_show` has the commands that print and check packs."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Annotated, Any, Literal

import tyro

from robocas_ms3.cli import assets_show
from robocas_ms3.cli.assets_show import require_mesh_tools
from robocas_ms3.cli.options import CORES, Folders, Jobs, Maybe, Several
from robocas_ms3.core.checks import check_number
from robocas_ms3.core.text import format_count

CONTACT_SHEET = "contact_sheet.png"
MAX_SHEET_ASSETS = 60  # assets on the contact sheet of an import
# `asset_tools.pipeline.AssetJob`, imported only when a command runs
Job = Any


@dataclass(kw_only=True)
class _ImportOptions:
    jobs: Jobs = CORES
    """Number of processes. Default: one per CPU core."""
    skip_errors: bool = False
    """Skip models with errors. Default: stop at the first error."""
    overwrite: bool = False
    """Replace a pack of this name that was imported from other files or with other settings.
    Unchanged assets are copied from the cache."""

    def __post_init__(self) -> None:
        check_number("--jobs", self.jobs, 1)


@dataclass(kw_only=True)
class ImportScans(_ImportOptions):
    """Import a folder of raw scans as a pack: one object per mesh file or subfolder.

    Each scan is repaired, closed, decomposed into convex hulls, decimated for rendering, and annotated with resting
    poses and grasps. Then it is dropped, grasped and shaken in simulation, and the measurements are stored. Finished
    objects are cached: after an interruption, the same command continues.

    Example: robocas assets import-scans scans/ --pack mine --units cm
    """

    source: Annotated[Path, tyro.conf.Positional]
    """Folder of the scans (OBJ, GLB, PLY, STL, ...)."""
    pack: str
    """Name of the new pack."""
    units: Maybe[Literal["m", "cm", "mm", "inch"]] = None
    """Unit of length of the files. Default: estimated from the sizes of all scans."""
    up: Maybe[Literal["x", "y", "z", "-x", "-y", "-z"]] = None
    """Axis that points up in the files. Default: estimated for each scan."""
    masses: Maybe[Path] = None
    """YAML file with masses in kg by object id. Default: estimated from the volumes."""
    licence: str = "unknown"
    """Licence of the scans, for the manifest."""
    attribution: str = "unknown"
    """Authors of the scans, for the manifest."""


@dataclass(kw_only=True)
class ImportGraspNet(_ImportOptions):
    """Import the models of GraspNet-1Billion as a pack, with its grasps if the folder grasp_label/ exists.

    The objects have the ids of their stand-ins in the builtin pack, so a task configuration runs with either pack.

    Example: robocas assets import-graspnet downloads/graspnet
    """

    root: Annotated[Path, tyro.conf.Positional]
    """Folder of GraspNet-1Billion, with models/NNN/textured.obj and grasp_label/NNN_labels.npz."""
    pack: str = "graspnet"
    """Name of the new pack."""
    ids: Several[int] = ()
    """Numbers of objects in GraspNet-1Billion. Default: the 46 objects of RoboCAS."""


@dataclass(kw_only=True)
class ImportYCB(_ImportOptions):
    """Import the YCB objects of ManiSkill as a pack (download: python -m mani_skill.utils.download_asset ycb).

    Example: robocas assets import-ycb
    """

    root: Annotated[Maybe[Path], tyro.conf.Positional] = None
    """Folder of the YCB objects. Default: the download folder of ManiSkill."""
    pack: str = "ycb"
    """Name of the new pack."""
    ids: Several[str] = ()
    """Ids of YCB objects, such as 005_tomato_soup_can. Default: all."""


@dataclass(kw_only=True)
class ImportPartNet(_ImportOptions):
    """Import PartNet-Mobility models as a pack of furniture.

    Example: robocas assets import-partnet downloads/7179 --annotations annotations
    """

    models: Folders
    """Folders of models, each with a mobility.urdf."""
    template: bool = False
    """Print an annotation file for the first model, to be completed by hand, and import nothing."""
    pack: str = "partnet"
    """Name of the new pack."""
    annotations: Maybe[Path] = None
    """Folder with an annotation file ID.yaml for each model; ID is the name of the model's folder.
    Default: bundled annotations of the six models of RoboCAS-v0."""


@dataclass(kw_only=True)
class Build:
    """Build the builtin pack from its Python code (asset_tools/builtin); needs a clone of the repository.

    Example: robocas assets build --ids plate --out packs/plate
    """

    out: Maybe[Path] = None
    """Folder of the pack. Default: the folder of the builtin pack."""
    ids: Several[str] = ()
    """Ids of the assets to build; needs --out. Default: all."""
    jobs: Jobs = CORES
    """Number of processes. Default: one per CPU core."""


def import_scans(command: ImportScans) -> int:
    require_mesh_tools()
    from asset_tools.import_scans import ImportSettings, make_scan_jobs

    out, masses = _target(command.pack), _masses(command.masses)
    settings = ImportSettings(command.units, command.up, masses, command.licence, command.attribution)
    from robocas_ms3.cli.terminal import print_line

    jobs = make_scan_jobs(
        command.source, settings, partial(_inspect, command), lambda reason: print_line(f"skipped {reason}")
    )
    return _import_pack(jobs, command, out, "scan")


def import_graspnet(command: ImportGraspNet) -> int:
    require_mesh_tools()
    from asset_tools.graspnet.importer import make_graspnet_jobs

    out = _target(command.pack)
    jobs = make_graspnet_jobs(command.root, command.ids, partial(_inspect, command))
    return _import_pack(jobs, command, out, "GraspNet object")


def import_ycb(command: ImportYCB) -> int:
    require_mesh_tools()
    from asset_tools.import_ycb import make_ycb_jobs

    out = _target(command.pack)
    jobs = make_ycb_jobs(command.root, command.ids, partial(_inspect, command))
    return _import_pack(jobs, command, out, "YCB object")


def import_partnet(command: ImportPartNet) -> int:
    from robocas_ms3.core.errors import AssetError

    require_mesh_tools()
    from asset_tools.partnet.importer import make_partnet_jobs
    from asset_tools.partnet.template import make_template

    if not command.models:
        expected, fix = "folders with a mobility.urdf", "Pass at least one folder."
        raise AssetError("missing model folder", where="DIR", expected=expected, fix=fix, usage=True)
    if command.template:
        from robocas_ms3.cli.terminal import print_text

        print_text(make_template(command.models[0]))
        return 0
    jobs = make_partnet_jobs(command.models, command.annotations)
    return _import_pack(jobs, command, _target(command.pack), "PartNet model")


def build(command: Build) -> int:
    from robocas_ms3.core.errors import AssetError
    from robocas_ms3.core.paths import builtin_packs_dir

    try:
        require_mesh_tools()
        from asset_tools.builtin.build import DESCRIPTION, FORMULAS_HASH, NAME, compute_formulas_hash, make_builtin_jobs
    except ModuleNotFoundError as error:
        if error.name != "asset_tools.builtin":
            raise
        raise AssetError(
            "the code that builds the builtin pack is not installed",
            expected="the folder asset_tools/builtin of the repository",
            found="an installed wheel",
            fix="Use the bundled pack, or clone the repository to change it.",
        ) from error
    if command.ids and command.out is None:
        what, fix = "--ids needs --out, since some assets cannot replace the whole builtin pack", "Pass --out FOLDER."
        raise AssetError(what, expected="--out FOLDER", found="no --out", fix=fix, usage=True)
    out = command.out or builtin_packs_dir() / NAME
    options = _ImportOptions(jobs=command.jobs, overwrite=True)
    status = _write(make_builtin_jobs(command.ids), options, out, DESCRIPTION, record=False)
    if status == 0 and command.out is None:
        (out / FORMULAS_HASH).write_text(f"{compute_formulas_hash()}\n")
    return status


def _inspect(command: _ImportOptions, models: Mapping[str, Any]) -> Mapping[str, Any]:
    from asset_tools.inspection import inspect_models
    from robocas_ms3.cli.progress import ProgressBar

    with ProgressBar("models read", transient=True) as bar:
        bar.start(len(models))
        return inspect_models(models, command.jobs, bar.advance)


def _target(name: str) -> Path:
    """Return the folder of an imported pack; raise AssetError if the name is invalid or taken by a bundled pack."""
    from asset_tools.pipeline import check_pack_folder
    from robocas_ms3.core.errors import AssetError
    from robocas_ms3.core.paths import builtin_packs_dir, data_dir

    if (builtin_packs_dir() / name).exists() or Path(name).name != name:
        what, fix = "invalid name for an imported pack", "Choose another name."
        expected = "a name without slashes that no bundled pack has"
        raise AssetError(what, where="--pack", expected=expected, found=repr(name), fix=fix, usage=True)
    out = data_dir() / "packs" / name
    check_pack_folder(out)
    return out


def _import_pack(jobs: list[Job], command: _ImportOptions, out: Path, what: str) -> int:
    from asset_tools.pipeline import check_jobs, is_up_to_date
    from robocas_ms3.assets.pack import load_pack
    from robocas_ms3.cli.terminal import print_line
    from robocas_ms3.core.errors import AssetError, OutputExistsError

    if not command.skip_errors:
        check_jobs(jobs)
    if is_up_to_date(jobs, out, skip_errors=command.skip_errors):
        try:
            load_pack(out)
        except AssetError as error:
            print_line(f"the pack {out.name} is damaged and is imported again: {error}")
        else:
            print_line(f"{out}: unchanged, nothing to import")
            if not (out / CONTACT_SHEET).exists():
                _draw_sheet(out)
            return 0
    elif out.exists() and not command.overwrite:
        what = "this pack exists, and was imported from other files or with other settings or versions"
        fix = "Pass --overwrite to replace the pack, or choose another name with --pack."
        raise OutputExistsError(what, where=out, fix=fix)
    return _write(jobs, command, out, format_count(len(jobs), what))


def _write(jobs: list[Job], command: _ImportOptions, out: Path, description: str, *, record: bool = True) -> int:
    from asset_tools.pipeline import AssetJobResult, write_pack
    from robocas_ms3.cli.progress import ProgressBar
    from robocas_ms3.cli.terminal import print_line
    from robocas_ms3.core.paths import cache_dir

    with ProgressBar(f"assets of {out.name} processed") as bar:
        bar.start(len(jobs))

        def on_made(made: AssetJobResult) -> None:
            bar.advance()
            if made.asset is None:
                bar.add_note(f"skipped: {made.error}")
                return
            for repair in made.asset.repairs:
                if repair.startswith("warning:"):
                    bar.add_note(f"{made.id}: {repair}")

        results = write_pack(
            jobs,
            out,
            cache_dir() / "assets",
            description=description,
            processes=command.jobs,
            skip_errors=command.skip_errors,
            record=record,
            on_made=on_made,
        )
    assets_show.info(assets_show.Info(pack=str(out)))
    bad = [made.id for made in results if made.asset is None]
    skipped = f"; {len(bad)} skipped: {', '.join(bad)}" if bad else ""
    print_line(f"wrote {out}: {format_count(len(results) - len(bad), 'asset')}{skipped}")
    if record:
        _draw_sheet(out)
    return 0


def _draw_sheet(folder: Path) -> None:
    from asset_tools.contact_sheet import write_contact_sheet
    from robocas_ms3.assets.pack import load_pack
    from robocas_ms3.cli.progress import spinner
    from robocas_ms3.cli.terminal import print_line
    from robocas_ms3.core.errors import AssetError

    pack = load_pack(folder)
    ids = [asset.id for asset in pack.manifest.assets]
    try:
        with spinner(f"rendering {format_count(len(ids[:MAX_SHEET_ASSETS]), 'asset')}"):
            write_contact_sheet(pack, folder / CONTACT_SHEET, ids[:MAX_SHEET_ASSETS])
    except AssetError as error:
        print_line(f"the contact sheet was not rendered: {error}")
        return
    rest = f"; all {len(ids)} assets: robocas assets sheet {folder.name}" if len(ids) > MAX_SHEET_ASSETS else ""
    print_line(f"contact sheet: {folder / CONTACT_SHEET}{rest}")


def _masses(path: Path | None) -> dict[str, float]:
    from robocas_ms3.core.documents import load_yaml
    from robocas_ms3.core.errors import AssetError

    if path is None:
        return {}
    try:
        masses = {str(key): float(value) for key, value in load_yaml(path).items()}
        if wrong := {key: mass for key, mass in masses.items() if not 0 < mass < 1000}:
            raise ValueError(f"a mass out of range: {wrong}")
    except (OSError, AttributeError, TypeError, ValueError) as error:
        what, expected = f"invalid file {path}", "a YAML mapping of object ids to masses, > 0 and < 1000 kg"
        raise AssetError(what, where="--masses", expected=expected, found=error) from error
    return masses


DESCRIPTION = "List, check and import asset packs. Without a command: list."
COMMANDS = {
    "list": assets_show.list_packs,
    "info": assets_show.info,
    "verify": assets_show.verify,
    "sheet": assets_show.sheet,
    "build": build,
    "import-scans": import_scans,
    "import-graspnet": import_graspnet,
    "import-ycb": import_ycb,
    "import-partnet": import_partnet,
}
DEFAULT = "list"
