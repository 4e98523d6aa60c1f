"""``robocas assets``: make packs; `assets_show` has the commands that look at them."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Annotated, Any, Literal

import tyro

from robocas_ms3.cli import assets_show
from robocas_ms3.cli.assets_show import require_mesh_tools
from robocas_ms3.cli.options import CORES, Jobs, Maybe, Several
from robocas_ms3.core.checks import check_number
from robocas_ms3.core.text import format_count

CONTACT_SHEET = "contact_sheet.png"
SHEET = 60  # assets on the contact sheet of an import
# `asset_tools.pipeline.Job`, which only loads when a command runs
Job = Any


@dataclass(kw_only=True)
class _Making:
    jobs: Jobs = CORES
    """Processes. Default: one for each CPU core."""
    skip_errors: bool = False
    """Leave out models with errors, instead of stopping at the first one."""
    overwrite: bool = False
    """Replace a pack of this name that was made from other files or settings; unchanged assets are reused."""

    def __post_init__(self) -> None:
        check_number("--jobs", self.jobs, 1)


@dataclass(kw_only=True)
class ImportScans(_Making):
    """Make a pack from a folder of raw scans: one object for each mesh file or subfolder.

    Each scan is repaired, closed, decomposed into convex hulls, decimated for rendering, and annotated with resting
    poses and grasps. Then it is dropped, grasped and shaken in simulation, and the outcome is stored. Finished objects
    are cached, so an interrupted import continues where it stopped.

    Example: robocas assets import-scans scans/ --pack mine --units cm
    """

    source: Annotated[Path, tyro.conf.Positional]
    """Folder of the scans (OBJ, GLB, PLY, STL, ...)."""
    pack: str
    """Name of the new pack."""
    units: Maybe[Literal["m", "cm", "mm", "inch"]] = None
    """Unit of the files. Default: guessed from the sizes of all of them."""
    up: Maybe[Literal["x", "y", "z", "-x", "-y", "-z"]] = None
    """Axis that points up in the files. Default: guessed for each."""
    masses: Maybe[Path] = None
    """YAML file with masses in kg by object id. Default: estimated from the volume."""
    licence: str = "unknown"
    """Licence of the scans, for the manifest."""
    attribution: str = "unknown"
    """Whom to name, for the manifest."""


@dataclass(kw_only=True)
class ImportGraspNet(_Making):
    """Make a pack from GraspNet-1Billion as downloaded: models/ and, if there, grasp_label/.

    Objects get the ids that the builtin pack uses for their stand-ins, so that a task configuration runs on either.

    Example: robocas assets import-graspnet downloads/graspnet
    """

    root: Annotated[Path, tyro.conf.Positional]
    """GraspNet's folder, with models/NNN/textured.obj and grasp_label/NNN_labels.npz."""
    pack: str = "graspnet"
    """Name of the new pack."""
    ids: Several[int] = ()
    """GraspNet's numbers. Default: RoboCAS's 46."""


@dataclass(kw_only=True)
class ImportYCB(_Making):
    """Make a pack from the YCB objects that ManiSkill downloads (python -m mani_skill.utils.download_asset ycb).

    Example: robocas assets import-ycb
    """

    root: Annotated[Maybe[Path], tyro.conf.Positional] = None
    """ManiSkill's YCB folder. Default: where ManiSkill puts it."""
    pack: str = "ycb"
    """Name of the new pack."""
    ids: Several[str] = ()
    """Names such as 005_tomato_soup_can. Default: all."""


@dataclass(kw_only=True)
class ImportPartNet(_Making):
    """Make a pack of furniture from PartNet-Mobility models.

    Example: robocas assets import-partnet downloads/7179 --annotations annotations
    """

    models: Annotated[Several[Path], tyro.conf.Positional]
    """Folders of models, each with a mobility.urdf."""
    template: bool = False
    """Import nothing; print an annotation to start from, with the joints of the first model."""
    pack: str = "partnet"
    """Name of the new pack."""
    annotations: Maybe[Path] = None
    """Folder with <id>.yaml for models that none is shipped for."""


@dataclass(kw_only=True)
class Build:
    """Make the builtin pack again from its formulas; only in a clone of the repository.

    Example: robocas assets build --ids plate --out packs/plate
    """

    out: Maybe[Path] = None
    """Its folder. Default: where the package has it."""
    ids: Several[str] = ()
    """Only these assets; needs --out. Default: all."""
    jobs: Jobs = CORES
    """Processes. Default: one for each CPU core."""


def import_scans(command: ImportScans) -> int:
    require_mesh_tools()
    from asset_tools.import_scans import ImportSettings, scan_jobs

    out, masses = _target(command.pack), _masses(command.masses)
    settings = ImportSettings(command.units, command.up, masses, command.licence, command.attribution)
    from robocas_ms3.cli.terminal import print_line

    jobs = scan_jobs(
        command.source, settings, partial(_inspect, command), lambda reason: print_line(f"skipped {reason}")
    )
    return _make(jobs, command, out, "scan")


def import_graspnet(command: ImportGraspNet) -> int:
    require_mesh_tools()
    from asset_tools.graspnet.importer import graspnet_jobs

    out = _target(command.pack)
    jobs = graspnet_jobs(command.root, command.ids, partial(_inspect, command))
    return _make(jobs, command, out, "GraspNet object")


def import_ycb(command: ImportYCB) -> int:
    require_mesh_tools()
    from asset_tools.import_ycb import ycb_jobs

    out = _target(command.pack)
    jobs = ycb_jobs(command.root, command.ids, partial(_inspect, command))
    return _make(jobs, command, out, "YCB object")


def import_partnet(command: ImportPartNet) -> int:
    from robocas_ms3.core.errors import AssetError

    require_mesh_tools()
    from asset_tools.partnet.importer import partnet_jobs
    from asset_tools.partnet.template import template

    if not command.models:
        raise AssetError("no model given", expected="folders with a mobility.urdf", fix="Give at least one.")
    if command.template:
        from robocas_ms3.cli.terminal import print_text

        print_text(template(command.models[0]))
        return 0
    return _make(partnet_jobs(command.models, command.annotations), command, _target(command.pack), "PartNet model")


def build(command: Build) -> int:
    from robocas_ms3.core.errors import AssetError
    from robocas_ms3.core.paths import builtin_packs_dir

    try:
        require_mesh_tools()
        from asset_tools.builtin.build import DESCRIPTION, FORMULAS_HASH, NAME, builtin_jobs, formulas_hash
    except ModuleNotFoundError as error:
        if error.name != "asset_tools.builtin":
            raise
        raise AssetError(
            "the formulas of the builtin pack are not installed",
            expected="asset_tools/builtin of the repository",
            found="an installed wheel",
            fix="Clone the repository to change them; the pack itself is installed and complete.",
        ) from error
    if command.ids and command.out is None:
        raise AssetError("the shipped pack is made as a whole", found="--ids without --out", fix="Pass --out FOLDER.")
    out = command.out or builtin_packs_dir() / NAME
    making = _Making(jobs=command.jobs, overwrite=True)
    status = _write(builtin_jobs(command.ids), making, out, DESCRIPTION, record=False)
    if status == 0 and command.out is None:
        (out / FORMULAS_HASH).write_text(f"{formulas_hash()}\n")
    return status


def _inspect(command: _Making, models: Mapping[str, Any]) -> Mapping[str, Any]:
    from asset_tools.inspection import inspect_models
    from robocas_ms3.cli.progress import ProgressBar

    with ProgressBar("models read", transient=True) as bar:
        bar.start(len(models))
        return inspect_models(models, command.jobs, bar.advance)


def _target(name: str) -> Path:
    """Return the folder of an imported pack; raise AssetError if no imported pack may have this name."""
    from asset_tools.pipeline import check_target
    from robocas_ms3.core.errors import AssetError
    from robocas_ms3.core.paths import builtin_packs_dir, data_dir

    if (builtin_packs_dir() / name).exists() or Path(name).name != name:
        raise AssetError("this can't be the name of an imported pack", found=name, fix="Choose another with --pack.")
    out = data_dir() / "packs" / name
    check_target(out)
    return out


def _make(jobs: list[Job], command: _Making, out: Path, what: str) -> int:
    from asset_tools.pipeline import check_jobs, made_of
    from robocas_ms3.assets.pack import load_pack
    from robocas_ms3.cli.terminal import print_line
    from robocas_ms3.core.errors import AssetError, OutputExistsError

    if not command.skip_errors:
        check_jobs(jobs)
    if made_of(jobs, out, skip_errors=command.skip_errors):
        try:
            load_pack(out)
        except AssetError as error:
            print_line(f"making it again: {error}")
        else:
            print_line(f"{out} is up to date")
            if not (out / CONTACT_SHEET).exists():
                _draw_sheet(out)
            return 0
    elif out.exists() and not command.overwrite:
        what = "a pack of this name exists; its files, settings or versions were others"
        fix = "Pass --overwrite to update it, or choose another name with --pack."
        raise OutputExistsError(what, where=out, fix=fix)
    return _write(jobs, command, out, format_count(len(jobs), what))


def _write(jobs: list[Job], command: _Making, out: Path, description: str, *, record: bool = True) -> int:
    from asset_tools.pipeline import JobResult, write_pack
    from robocas_ms3.cli.progress import ProgressBar
    from robocas_ms3.cli.terminal import print_line
    from robocas_ms3.core.paths import cache_dir

    with ProgressBar(f"assets of {out.name} processed") as bar:
        bar.start(len(jobs))

        def on_made(made: JobResult) -> None:
            bar.advance()
            if made.asset is None:
                bar.add_note(f"left out: {made.error}")
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
    left_out = f"; {len(bad)} left out: {', '.join(bad)}" if bad else ""
    print_line(f"wrote {out}: {format_count(len(results) - len(bad), 'asset')}{left_out}")
    if record:
        _draw_sheet(out)
    return 0


def _draw_sheet(folder: Path) -> None:
    from asset_tools.contact_sheet import contact_sheet
    from robocas_ms3.assets.pack import load_pack
    from robocas_ms3.cli.progress import spinner
    from robocas_ms3.cli.terminal import print_line
    from robocas_ms3.core.errors import AssetError

    pack = load_pack(folder)
    ids = [asset.id for asset in pack.manifest.assets]
    try:
        with spinner(f"drawing {format_count(len(ids[:SHEET]), 'asset')}"):
            contact_sheet(pack, folder / CONTACT_SHEET, ids[:SHEET])
    except AssetError as error:
        print_line(f"no contact sheet: {error}")
        return
    rest = f"; `robocas assets sheet {folder.name}` draws all {len(ids)}" if len(ids) > SHEET else ""
    print_line(f"contact sheet: {folder / CONTACT_SHEET}{rest}")


def _masses(path: Path | None) -> dict[str, float]:
    from robocas_ms3.core.documents import load_yaml
    from robocas_ms3.core.errors import AssetError

    if path is None:
        return {}
    try:
        data = load_yaml(path)
        masses = {str(key): float(value) for key, value in data.items()}
        if not all(0 < mass < 1000 for mass in masses.values()):
            raise ValueError("masses must be positive")
        return masses
    except (OSError, AttributeError, TypeError, ValueError) as error:
        raise AssetError(
            "can't read the masses", where=path, expected="a YAML mapping: object id: kg", found=error
        ) from error


DESCRIPTION = "Look at asset packs, and make new ones from scans and datasets. Without a command: list."
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
