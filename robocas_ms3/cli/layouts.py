"""``robocas layouts build | info``: layout caches, filled ahead."""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import tyro

if TYPE_CHECKING:
    from robocas_ms3.scenes.cache import LayoutCache
    from robocas_ms3.scenes.layout_table import Engine, SeedPair

from robocas_ms3.cli.options import CORES, Jobs, Maybe, Repeated
from robocas_ms3.core.text import format_count


@dataclass
class Build:
    """Make the layouts of a range of seeds ahead, so that a reset only sets poses.

    Existing layouts are kept: the same command continues after an interruption.

    One env has objects and arrangement of one seed. Several envs are built with the objects of seeds 0, 1, ... and keep
    them, while arrangements change: for num_envs=4, --objects 0:4 --seeds 0:100 is what resets without a seed use.
    These are also written as one file, which such envs read at once. Where that is for a GPU, its engine tries each of
    them: a layout of which an object moves more than 3 mm in the first second is marked, and no reset takes it.

    Example: robocas layouts build pick_table_scattered --seeds 0:100 --set objects.count=12
    """

    config: Annotated[str, tyro.conf.Positional]
    """Name of a shipped task configuration, or a YAML file."""
    set: Repeated[str] = ()
    """Set a key of the configuration, such as `--set objects.count=12`; repeatable (docs/configuration.md). The layouts
    are those of the resolved configuration."""
    pack: str = "builtin"
    """Object pack: its name, or its folder."""
    furniture_pack: str = "builtin"
    """Pack of the furniture: its name, or its folder."""
    seeds: str = "0:100"
    """First seed, and the one after the last: 0:100. Each set of --objects also has its own seed's layout."""
    objects: Maybe[str] = None
    """Seeds of objects of several envs, 0:4 or 3,7. Default: those of one env."""
    engine: Literal["auto", "cpu", "gpu"] = "auto"
    """With --objects: PhysX on the CPU or on a GPU, which is to run them. Auto: a GPU if there is one."""
    jobs: Jobs = CORES
    """Processes. Default: one for each CPU core."""
    out: Maybe[Path] = None
    """Folder of all layout caches. Default: where environments look for them."""


@dataclass
class Info:
    """List the layout caches on this machine.

    Example: robocas layouts info
    """

    folder: Maybe[Path] = None
    """Folder of all layout caches. Default: where environments look for them."""


def build(command: Build) -> int:
    from robocas_ms3.assets.pack import load_pack
    from robocas_ms3.cli.progress import ProgressBar
    from robocas_ms3.cli.terminal import print_line
    from robocas_ms3.core.checks import check_number
    from robocas_ms3.scenes.config import load_task_config

    check_number("--jobs", command.jobs, 1)
    objects = None if command.objects is None else parse_seeds(command.objects, "--objects", listed=True)
    seeds = parse_seeds(command.seeds, "--seeds")
    config = load_task_config(command.config, overrides=command.set)
    packs = load_pack(command.pack), load_pack(command.furniture_pack)  # before what takes seconds to import
    from robocas_ms3.scenes.cache import LayoutCache, seed_pairs
    from robocas_ms3.scenes.model import SceneModel

    pairs = seed_pairs(seeds, objects)
    cache = LayoutCache(SceneModel.load(config, *packs), command.out or "auto")
    engine = choose_engine(command.engine) if objects is not None else None
    there = len(pairs) - len(cache.missing(pairs))
    failures = 0
    with ProgressBar("layouts made") as bar:
        bar.start(len(pairs), there)
        for (chosen, seed), problem in cache.fill(pairs, command.jobs):
            if problem:
                failures += 1
                which = f"seed {seed}" if objects is None else f"objects {chosen}, seed {seed}"
                bar.note(f"{which}: {problem}")
            else:
                bar.advance()
    if engine is not None:  # for several envs, whose resets then read one file
        cache.write_table(engine, pairs)
    moving = 0
    if engine == "gpu":
        moving = try_all(cache, engine, pack=command.pack, furniture_pack=command.furniture_pack)
    made = len(pairs) - there - failures
    print_line(
        f"{format_count(made, 'layout')} made, {there} there already, {format_count(failures, 'seed')} without one"
    )
    if engine is not None and (table := cache.table(engine)) is not None:
        sets, arrangements = table.rows.shape
        size = f"{format_count(sets, 'set')} of objects by {format_count(arrangements, 'seed')}"
        print_line(f"table: {cache.table_path(engine)}, {size}")
    if engine == "gpu":
        print_line(f"objects of {moving} move when the GPU simulates them: no reset takes these")
    print_line(f"cache: {cache.folder}")
    return 1 if failures else 0


def choose_engine(wanted: Literal["auto", "cpu", "gpu"]) -> Engine:
    """Return the engine that is to run the layouts; raise ConfigError if a GPU is wanted and there is none."""
    from torch.cuda import is_available

    from robocas_ms3.core.errors import ConfigError

    if wanted == "gpu" and not is_available():
        raise ConfigError("needs a GPU", where="--engine", found="no CUDA device", fix="Take --engine cpu.")
    return "gpu" if wanted != "cpu" and is_available() else "cpu"


def try_all(cache: LayoutCache, engine: Engine, **packs: str) -> int:
    """Let the engine try layouts in state `UNCHECKED`; return how many layouts of the table it moves."""
    from robocas_ms3.cli.progress import ProgressBar
    from robocas_ms3.scenes.layout_table import LayoutStatus
    from robocas_ms3.tasks.layout_stability import check_layouts, status_of, unchecked_layouts

    seeds = unchecked_layouts(cache, engine)
    if seeds:
        found: dict[SeedPair, LayoutStatus] = {}
        trial = check_layouts(cache, engine, seeds, **packs)
        try:
            with ProgressBar("layouts tried") as bar:
                bar.start(sum(map(len, seeds.values())))
                for pair, moved in trial:
                    found[pair] = status_of(moved)
                    bar.advance()
        finally:  # interrupted, it keeps what was found
            cache.write_statuses(engine, found)
    table = cache.table(engine)
    return len(table.pairs(LayoutStatus.UNSTABLE)) if table else 0


def info(command: Info) -> int:
    from robocas_ms3.cli.terminal import print_line, print_table
    from robocas_ms3.core.documents import load_json
    from robocas_ms3.scenes.cache import ABOUT, caches_folder, count_layouts

    root = caches_folder(command.folder or "auto")
    rows = []
    for path in sorted(root.glob(f"*/{ABOUT}")):
        try:
            about = load_json(path)
            config, furniture = about["config"], ", ".join(sorted(about["furniture"]))
            of = (config["task"], config["layout"]["kind"], config["objects"]["count"], about["object_pack"]["name"])
        except (OSError, ValueError, KeyError, TypeError):  # the layouts are still of use
            of, furniture = (f"{ABOUT} is damaged", "", "", ""), ""
        rows.append((path.parent.name, count_layouts(path.parent), *of, furniture))
    print_table(("cache", "layouts", "task", "layout", "objects", "object pack", "furniture"), rows)
    if not rows:
        print_line(f"no layout caches in {root}")
    return 0


def parse_seeds(text: str, option: str, *, listed: bool = False) -> list[int]:
    """Return the seeds of ``FIRST:END``, or, where that is allowed, of a list ``SEED,SEED``."""
    from robocas_ms3.core.errors import ConfigError

    if listed and re.fullmatch(r"\d+(,\d+)*", text):
        return list(dict.fromkeys(int(seed) for seed in text.split(",")))
    match = re.fullmatch(r"(\d+):(\d+)", text)
    if match is None or int(match[1]) >= int(match[2]):
        expected = "FIRST:END such as 0:100" + (", or 3,7" if listed else "")
        raise ConfigError("no range of seeds", where=option, expected=expected, found=text)
    return list(range(int(match[1]), int(match[2])))


DESCRIPTION = "Build layouts ahead, and list those that are there."
COMMANDS = {"build": build, "info": info}
