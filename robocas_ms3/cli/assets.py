"""``robocas assets``: look at asset packs, make new ones."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Literal

import tyro

Subcommand = tyro.conf.subcommand


@dataclass
class ListPacks:
    """List the asset packs that are there."""


@dataclass
class Info:
    """Show what is in a pack: size, mass, hulls, grasps, repairs."""

    pack: Annotated[str, tyro.conf.Positional]
    """Its name, or its folder."""


@dataclass
class Verify:
    """Check every file of a pack against its manifest."""

    pack: Annotated[str, tyro.conf.Positional]
    """Its name, or its folder."""


@dataclass
class ImportScans:
    """Make a pack from a folder of raw scans: one object for each mesh file or subfolder.

    Each scan is closed, decomposed into convex hulls, decimated for rendering, and annotated with resting poses and
    grasps.
    """

    source: Annotated[Path, tyro.conf.Positional]
    """Folder of the scans (OBJ, GLB, PLY, STL, ...)."""
    pack: str
    """Name of the new pack."""
    units: Literal["m", "cm", "mm", "inch"] | None = None
    """Unit of the files. Default: guessed from the sizes of all of them."""
    up: Literal["x", "y", "z", "-x", "-y", "-z"] | None = None
    """Axis that points up in the files. Default: guessed for each."""
    masses: Path | None = None
    """YAML file with masses in kg by object id. Default: estimated from the volume."""
    licence: str = "unknown"
    """Licence of the scans, for the manifest."""
    attribution: str = "unknown"
    """Whom to name, for the manifest."""
    jobs: int = 2
    """Processes."""
    skip_bad: bool = False
    """Leave out scans that can't be imported, instead of giving up."""
    overwrite: bool = False
    """Replace the pack if it exists."""


@dataclass
class BuildBuiltin:
    """Make the builtin pack anew from its formulas (for people who work on it)."""

    out: Path | None = None
    """Its folder. Default: where the package has it."""
    jobs: int = 2
    """Processes."""


@dataclass
class Assets:
    """Look at asset packs, and make new ones from scans."""

    command: (
        Annotated[ListPacks, Subcommand("list")]
        | Annotated[Info, Subcommand("info")]
        | Annotated[Verify, Subcommand("verify")]
        | Annotated[ImportScans, Subcommand("import-scans")]
        | Annotated[BuildBuiltin, Subcommand("build-builtin")]
    ) = field(default_factory=ListPacks)
    """What to do."""


def main(cfg: Assets) -> int:
    """Run the command."""
    command = cfg.command
    if isinstance(command, Info):
        return _info(command)
    if isinstance(command, Verify):
        return _verify(command)
    if isinstance(command, ImportScans):
        return _import_scans(command)
    if isinstance(command, BuildBuiltin):
        return _build_builtin(command)
    return _list()


def _list() -> int:
    from rich.console import Console
    from rich.table import Table

    from robocas_ms3.assets.pack import load_pack, pack_folders

    table = Table("pack", "objects", "furniture", "folder")
    for name, folder in pack_folders().items():
        pack = load_pack(name)
        table.add_row(name, str(len(pack.objects)), str(len(pack.furniture)), str(folder))
    Console().print(table)
    return 0


def _info(command: Info) -> int:
    from rich.console import Console
    from rich.table import Table

    from robocas_ms3.assets.pack import load_pack

    pack = load_pack(command.pack)
    table = Table("object", "size (mm)", "mass (g)", "hulls", "overlap", "resting poses", "grasps", "repairs")
    for loaded in pack.objects.values():
        asset = loaded.asset
        table.add_row(
            asset.id,
            " x ".join(f"{1000 * side:.0f}" for side in asset.extents),
            f"{1000 * asset.mass:.0f}",
            str(asset.hull_count),
            f"{asset.volume_iou:.3f}",
            str(len(loaded.annotations.resting_poses)),
            str(asset.grasp_count),
            "; ".join(asset.repairs),
        )
    console = Console()
    console.print(table)
    if pack.furniture:
        console.print("furniture: " + ", ".join(pack.furniture))
    return 0


def _verify(command: Verify) -> int:
    from rich.console import Console

    from robocas_ms3.assets.pack import load_pack

    pack = load_pack(command.pack)
    for loaded in [*pack.objects.values(), *pack.furniture.values()]:
        _ = loaded.hulls
    for loaded in pack.objects.values():
        _ = loaded.annotations
    Console(highlight=False).print(f"{pack.name}: {len(pack.manifest.assets)} assets, every file is as it should be")
    return 0


def _import_scans(command: ImportScans) -> int:
    from rich.console import Console
    from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn

    from robocas_ms3.files import claim_output
    from robocas_ms3.paths import data_dir

    try:
        from asset_tools.import_scans import Imported, ImportSettings, find_scans, import_scans
    except ImportError as error:
        raise _missing(error) from error
    out = data_dir() / "packs" / command.pack
    claim_output(out, overwrite=False, resume=command.overwrite)
    settings = ImportSettings(command.units, command.up, _masses(command.masses), command.licence, command.attribution)
    console = Console(highlight=False, soft_wrap=True)
    columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeElapsedColumn())
    with Progress(*columns, console=Console(stderr=True)) as progress:
        bar = progress.add_task("scans", total=len(find_scans(command.source)))

        def on_result(result: Imported) -> None:
            progress.advance(bar)
            if result.asset is None:
                progress.console.print(f"left out: {result.error}", highlight=False)

        import_scans(command.source, out, settings, jobs=command.jobs, skip_bad=command.skip_bad, on_result=on_result)
    _info(Info(str(out)))
    console.print(f"wrote {out}; use it with --pack {command.pack}")
    return 0


def _build_builtin(command: BuildBuiltin) -> int:
    from rich.console import Console

    try:
        from asset_tools.builtin.build import main as build
    except ImportError as error:
        raise _missing(error) from error
    Console(highlight=False, soft_wrap=True).print(f"wrote {build(command.out, command.jobs)}")
    return 0


def _masses(path: Path | None) -> dict[str, float]:
    import yaml

    from robocas_ms3.errors import AssetError

    if path is None:
        return {}
    try:
        data = yaml.safe_load(path.read_text(encoding="utf-8"))
        return {str(key): float(value) for key, value in data.items()}
    except (OSError, yaml.YAMLError, AttributeError, TypeError, ValueError) as error:
        raise AssetError("can't read the masses", where=path, expected="a YAML mapping: object id: kg") from error


def _missing(error: ImportError) -> Exception:
    from robocas_ms3.errors import MissingExtraError

    return MissingExtraError(
        "mesh tools are not installed", found=error.name or error, fix="pip install 'robocas-ms3[assets]'"
    )
