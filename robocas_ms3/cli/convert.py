"""``robocas convert``."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

import tyro


@dataclass
class Convert:
    """Write a dataset from a trajectory file made by ``robocas generate``."""

    trajectory: Annotated[Path, tyro.conf.Positional]
    """F.h5, with F.json beside it."""
    out: Path
    """Folder of the dataset."""
    to: Literal["robocas"] = "robocas"
    """Format of the dataset."""
    rate: float = 5.0
    """Steps a second; must divide the control frequency."""
    embeddings: bool = True
    """Embed instruction and sub-goals (needs the extra 'language')."""
    video: bool = True
    """Write a video of each episode and a contact sheet into OUT/preview."""
    cameras: tuple[Literal["base_camera", "gripper_camera", "static_camera"], ...] = (
        "base_camera",
        "gripper_camera",
        "static_camera",
    )
    """Which cameras."""
    size: tuple[int, int] | None = None
    """Width and height of the pictures; default: the cameras' own, 640 480."""
    depth: bool = True
    """Store depth beside RGB."""
    image_format: Literal["png", "jpg", "webp"] = "png"
    """Of RGB; the loader released with RoboCAS opens png only."""
    include_failed: bool = False
    """Also convert episodes without success."""
    overwrite: bool = False
    """Replace the dataset that is there."""
    resume: bool = False
    """Go on with a conversion that was interrupted."""
    append: bool = False
    """Add to the dataset that is there; its episodes keep their numbers."""
    jobs: int = 1
    """Processes that render."""


def main(cfg: Convert) -> int:
    """Convert, with a progress bar; gives the exit code."""
    from rich.console import Console
    from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn

    from robocas_ms3.datasets.convert import convert
    from robocas_ms3.datasets.pictures import Pictures
    from robocas_ms3.datasets.video import write_previews

    console = Console(stderr=True)
    columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeElapsedColumn())
    progress = Progress(*columns, console=console)  # shown when there is something to do: an error is one line

    def start(count: int) -> None:
        progress.add_task("episodes", total=count)
        progress.start()

    try:
        done = convert(
            cfg.trajectory,
            cfg.out,
            rate_hz=cfg.rate,
            embeddings=cfg.embeddings,
            pictures=Pictures(cfg.cameras, cfg.size, cfg.depth, cfg.image_format),
            include_failed=cfg.include_failed,
            overwrite=cfg.overwrite,
            resume=cfg.resume,
            append=cfg.append,
            jobs=cfg.jobs,
            on_start=start,
            on_episode=lambda _: progress.advance(progress.task_ids[0]),
        )
        if cfg.video:
            videos = progress.add_task("videos", total=len(done.episodes) + done.kept)
            write_previews(cfg.out, on_video=lambda _: progress.advance(videos))
    finally:
        progress.stop()
    steps = sum(episode.steps for episode in done.episodes)
    megabytes = sum(episode.size for episode in done.episodes) / 1e6
    each = done.seconds / max(1, len(done.episodes))
    kept = f", {done.kept} kept" if done.kept else ""
    Console().print(
        f"{cfg.out}: {len(done.episodes)} episodes{kept}, {steps} steps, {megabytes:.0f} MB, {each:.1f} s an episode",
        soft_wrap=True,
        highlight=False,
    )
    return 0
