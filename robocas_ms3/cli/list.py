"""``robocas list``: print the tasks, configurations, robots, policies, baselines and asset packs."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from robocas_ms3.core.paths import builtin_packs_dir
from robocas_ms3.core.text import format_count

if TYPE_CHECKING:
    from importlib.metadata import EntryPoint

    from robocas_ms3.scenes.config import TaskConfig


@dataclass
class List:
    """List the tasks, bundled task configurations, robots, policies, baselines and asset packs.

    The column "needs pack" names asset packs that a configuration needs and that are not bundled. Import them with
    `robocas assets`.

    Example: robocas list --json
    """

    json: bool = False
    """Print the lists as JSON."""


def main(cfg: List) -> int:
    from robocas_ms3.cli.terminal import print_json

    found = list_all()
    if cfg.json:
        print_json(found)
    else:
        _print(found)
    return 0


def list_all() -> dict[str, list[dict[str, Any]]]:
    """Return the rows of each table by title; the rows of a table are dicts with equal keys.

    Each asset pack is loaded. The row of a damaged pack has an ``error`` and no objects. Policies and baselines of
    other packages are not imported, so an error in such a package appears only when its policy or baseline is used.
    """
    from robocas_ms3.assets.pack import find_packs, load_pack
    from robocas_ms3.baselines.registry import BASELINES
    from robocas_ms3.core.errors import AssetError
    from robocas_ms3.core.extensions import package_name
    from robocas_ms3.evaluation.policies import POLICIES, SUMMARIES
    from robocas_ms3.robots.registry import ROBOTS
    from robocas_ms3.scenes.config import bundled_configs, load_task_config
    from robocas_ms3.scenes.task_specs import TASKS

    tasks = [
        {"name": task.name, "env_id": task.env_id, "default_config": task.default_config, "summary": task.summary}
        for task in TASKS.values()
    ]
    configs = []
    for name, path in bundled_configs().items():
        config = load_task_config(path)
        scene = f"{format_count(config.objects.count, 'object')}, {config.layout.kind}, on the {config.support}"
        row = {"name": name, "task": config.task, "scene": scene, "needs_pack": _packs_to_import(config)}
        configs.append({**row, "description": config.description})
    robots = [{"name": name, "agent": robot.agent} for name, robot in ROBOTS.items()]
    policies = [{"name": name, "package": "robocas_ms3", "summary": SUMMARIES[name]} for name in POLICIES.builtin]
    for points in POLICIES.entry_points.values():
        policies += [
            {"name": point.name, "package": package_name(point), "summary": _summarize_policy(point)}
            for point in points
        ]
    baselines = [
        {"name": name, "package": "robocas_ms3", "summary": getattr(row, "description", "")}
        for name, row in BASELINES.builtin.items()
    ]
    for points in BASELINES.entry_points.values():
        baselines += [{"name": point.name, "package": package_name(point), "summary": ""} for point in points]
    packs = []
    for name, folder in find_packs().items():
        row: dict[str, Any] = {"name": name, "folder": str(folder), "megabytes": round(_size(folder) / 1e6, 1)}
        try:
            pack = load_pack(folder)
            packs.append(row | {"objects": sorted(pack.objects), "furniture": sorted(pack.furniture), "error": ""})
        except AssetError as error:
            packs.append(row | {"objects": [], "furniture": [], "error": str(error)})
    return {
        "tasks": tasks,
        "configs": configs,
        "robots": robots,
        "policies": policies,
        "baselines": baselines,
        "packs": packs,
    }


def _packs_to_import(config: TaskConfig) -> list[str]:
    """Return the names of the packs that a configuration needs for furniture and that are not bundled."""
    assets = [item.asset for item in (*config.furniture.values(), config.room, config.basket) if item is not None]
    packs = {asset.rpartition("/")[0] for asset in assets if "/" in asset}
    return sorted(pack for pack in packs if not (builtin_packs_dir() / pack).is_dir())


def _summarize_policy(point: EntryPoint) -> str:
    """Return the training of bundled weights, or the Python name of the policy of another package."""
    from robocas_ms3.baselines.policy import describe_bundled

    is_bundled = point.value.startswith("robocas_ms3.baselines.policy:")
    return describe_bundled(point.name) if is_bundled else point.value


def _size(folder: Path) -> int:
    return sum(path.stat().st_size for path in folder.rglob("*") if path.is_file())


def _print(found: dict[str, list[dict[str, Any]]]) -> None:
    from robocas_ms3.cli.terminal import print_table, table_console

    tables = {
        "tasks": ("name", "env_id", "default_config", "summary"),
        "configs": ("name", "task", "scene", "needs_pack", "description"),
        "robots": ("name", "agent"),
        "policies": ("name", "package", "summary"),
        "baselines": ("name", "package", "summary"),
        "packs": ("name", "objects", "furniture", "megabytes", "folder"),
    }
    for kind, columns in tables.items():
        rows = [[row[column] for column in columns] for row in found[kind]]
        cells = [[", ".join(cell) if isinstance(cell, list) else cell for cell in row] for row in rows]
        heads = [column.replace("_", " ") for column in columns]
        no_wrap = ("env id", "default config", "task")
        print_table(heads, cells, no_wrap=no_wrap, title=kind, title_justify="left", title_style="bold")
    for pack in found["packs"]:
        if pack["error"]:
            table_console().print(f"damaged pack {pack['name']}: {pack['error']}", style="red", soft_wrap=True)
