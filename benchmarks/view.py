"""Measure the time until the page of `robocas view` is shown in Chromium; print JSON.

python benchmarks/view.py --episodes 1000

JSON keys:
  episodes       number of episodes
  median, runs   medians over the runs, and values of each run, in seconds:
    server                                 from the command to the printed address, mostly the start of Python
    first_paint, first_contentful_paint    from the navigation to these events of the browser
    table, images, thumbnails_in_view      from the navigation until the list of episodes, the camera images of the
                                           first episode, and the 12 visible thumbnails are shown
    a_thumbnail_median, a_thumbnail_slowest   loading time of a thumbnail
    click_to_episode, click_to_images      from a click on an episode until its text and its camera images are shown
"""

from __future__ import annotations

import json
import os
import re
import shutil
import statistics
import subprocess
import sys
import tempfile
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import tyro

from robocas_ms3.datasets import ConversionSettings, convert, schema

ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT / "tests" / "support"))
THUMBNAILS = "[...document.querySelectorAll('.row img')]"
CAMERAS = "[...document.querySelectorAll('#cameras img')]"
LOADED = "every(img => img.complete && img.naturalWidth)"


@dataclass
class Benchmark:
    episodes: int = 1000
    """Number of episodes."""
    dataset: Path | None = None
    """RoboCAS folder whose episodes are multiplied. Default: synthetic episodes of 7 steps, 640 x 480, with depth."""
    runs: int = 3
    """Number of rounds, each with a new server and a new browser."""


def main(cfg: Benchmark) -> None:
    """Run the benchmark."""
    with tempfile.TemporaryDirectory(prefix="robocas-view-") as folder:
        source = cfg.dataset or _make_dataset(Path(folder))
        dataset = Path(folder) / "dataset"
        _multiply(shutil.copytree(source, Path(folder) / "source"), dataset, cfg.episodes)
        runs = [_measure(dataset, cfg.episodes) for _ in range(cfg.runs)]
    medians = {name: round(statistics.median(run[name] for run in runs), 3) for name in runs[0]}
    print(json.dumps({"episodes": cfg.episodes, "median": medians, "runs": runs}, indent=2))


def _make_dataset(folder: Path) -> Path:
    import synthetic  # pyright: ignore[reportMissingImports]

    trajectory = synthetic.write_trajectory(folder / "trajectory.h5")
    convert(
        ConversionSettings(
            trajectory,
            folder / "made_up",
            open_renderer=synthetic.RayCaster,
            embeddings=False,
            video=False,
            size=(640, 480),
        )
    )
    return folder / "made_up"


def _multiply(source: Path, out: Path, count: int) -> None:
    """Write a dataset whose images and arrays are links to those of a few episodes, with new seeds and failures."""
    settings = json.loads((source / schema.CONVERSION_FILE).read_text())
    info = json.loads((source / schema.DATA_INFO_FILE).read_text())
    numbers = sorted(settings["episodes"], key=int)
    tables: dict[str, dict[str, Any]] = {"ep_length": {}, "language_goal": {}, "step_goals": {}}
    entries = {}
    for number in range(count):
        of = numbers[number % len(numbers)]
        before, after = (root / schema.episode_folder(n) for root, n in ((source, int(of)), (out, number)))
        shutil.copytree(before, after, copy_function=os.link)
        scene = json.loads((before / schema.SCENE_FILE).read_text())
        if number % 10 == 3:
            recovery = {"range": [0, 40], "stage": ("grasp", "lift")[number // 10 % 2], "reason": "slipped"}
            scene["recorded"] = {**(scene["recorded"] or {}), "attempts": 2, "recoveries": [recovery]}
        (after / schema.SCENE_FILE).unlink()
        (after / schema.SCENE_FILE).write_text(json.dumps({**scene, "seed": number, "success": number % 17 != 5}))
        entries[str(number)] = {**settings["episodes"][of], "seed": number}
        for name, table in tables.items():
            table[str(number)] = info[name][of]
    split = {"train_eps": list(range(count - count // 10)), "val_eps": list(range(count - count // 10, count))}
    (out / schema.CONVERSION_FILE).write_text(json.dumps({**settings, "episodes": entries}))
    (out / schema.DATA_INFO_FILE).write_text(json.dumps({**info, **tables, **split}))


def _measure(dataset: Path, count: int) -> dict[str, float]:
    from browser import open_page  # pyright: ignore[reportMissingImports]

    with open_page() as page:
        start = time.perf_counter()
        command = [sys.executable, str(ROOT / "robocas_cli.py"), "view", str(dataset), "--no-open"]
        with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as server:
            assert server.stdout is not None
            found = {}
            try:
                address = re.search(r"http\S+", server.stdout.readline())
                assert address, "robocas view printed no address"
                found["server"] = time.perf_counter() - start
                found.update(_page(page, address[0], count))
            finally:
                server.terminate()
    return {name: round(value, 3) for name, value in found.items()}


def _page(page: Any, url: str, count: int) -> dict[str, float]:
    from browser import wait  # pyright: ignore[reportMissingImports]

    page.goto(url, wait_until="commit")
    wait(page, "document.querySelectorAll('#rows .row').length")
    table = page.evaluate("performance.now() / 1000")
    assert page.text_content("#count").startswith(f"{count} episodes")
    wait(page, f"{CAMERAS}.length && {CAMERAS}.{LOADED}")
    images = page.evaluate("performance.now() / 1000")
    wait(page, f"{THUMBNAILS}.slice(0, 12).{LOADED}")
    thumbnails = page.evaluate("performance.now() / 1000")
    paints = page.evaluate("performance.getEntriesByType('paint').map(entry => [entry.name, entry.startTime / 1000])")
    loads = page.evaluate(
        "performance.getEntriesByType('resource').filter(entry => entry.name.includes('thumbnails'))"
        ".map(entry => entry.duration / 1000)"
    )
    start = time.perf_counter()
    page.click(".row[data-episode='5']")
    wait(page, "document.querySelector('#summary').textContent.startsWith('Episode 5 ')")
    opened = time.perf_counter() - start
    wait(page, f"{CAMERAS}.every(img => img.src.includes('/images/5/')) && {CAMERAS}.{LOADED}")
    return {
        **{name.replace("-", "_"): seconds for name, seconds in paints},
        "table": table,
        "images": images,
        "thumbnails_in_view": thumbnails,
        "a_thumbnail_median": statistics.median(loads),
        "a_thumbnail_slowest": max(loads),
        "click_to_episode": opened,
        "click_to_images": time.perf_counter() - start,
    }


if __name__ == "__main__":
    main(tyro.cli(Benchmark, description=__doc__))
