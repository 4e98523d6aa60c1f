"""``robocas list``: tasks, shipped configurations, robots, policies, baselines, asset packs."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

from robocas_ms3.core.text import format_count


@dataclass
class List:
    """List the tasks, bundled task configurations, robots, policies, baselines and asset packs.

    Example: robocas list --json
    """

    json: bool = False
    """Print a machine-readable list."""


def main(cfg: List) -> int:
    from robocas_ms3.cli.terminal import print_json

    found = collect()
    if cfg.json:
        print_json(found)
    else:
        _print(found)
    return 0


def collect() -> dict[str, list[dict[str, Any]]]:
    """Gather what there is, verifying every pack; a damaged one has an ``error`` and no objects.

    Policies and baselines of other packages are not imported, so a broken one shows only when it is chosen.
    """
    from robocas_ms3.assets.pack import load_pack, pack_folders
    from robocas_ms3.baselines.registry import BASELINES
    from robocas_ms3.core.errors import AssetError
    from robocas_ms3.core.extensions import package_of
    from robocas_ms3.evaluation.policies import POLICIES
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
        configs.append({"name": name, "task": config.task, "scene": scene, "description": config.description})
    robots = [{"name": name, "agent": robot.agent} for name, robot in ROBOTS.items()]
    policies = [{"name": name, "package": "robocas_ms3", "of": "builtin"} for name in POLICIES.builtin]
    for points in POLICIES.entry_points.values():
        policies += [{"name": point.name, "package": package_of(point), "of": point.value} for point in points]
    baselines = [
        {"name": name, "package": "robocas_ms3", "about": getattr(row, "about", "")}
        for name, row in BASELINES.builtin.items()
    ]
    for points in BASELINES.entry_points.values():
        baselines += [{"name": point.name, "package": package_of(point), "about": ""} for point in points]
    packs = []
    for name, folder in pack_folders().items():
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


def _size(folder: Path) -> int:
    return sum(path.stat().st_size for path in folder.rglob("*") if path.is_file())


def _print(found: dict[str, list[dict[str, Any]]]) -> None:
    from robocas_ms3.cli.terminal import print_table, table_console

    tables = {
        "tasks": ("name", "env_id", "default_config", "summary"),
        "configs": ("name", "task", "scene", "description"),
        "robots": ("name", "agent"),
        "policies": ("name", "package", "of"),
        "baselines": ("name", "package", "about"),
        "packs": ("name", "objects", "furniture", "megabytes", "folder"),
    }
    for kind, columns in tables.items():
        rows = [[row[column] for column in columns] for row in found[kind]]
        cells = [[", ".join(cell) if isinstance(cell, list) else cell for cell in row] for row in rows]
        heads = [column.replace("_", " ") for column in columns]
        whole = ("env id", "default config", "task")
        print_table(heads, cells, whole=whole, title=kind, title_justify="left", title_style="bold")
    for pack in found["packs"]:
        if pack["error"]:
            table_console().print(f"damaged: {pack['error']}", style="red", soft_wrap=True)
