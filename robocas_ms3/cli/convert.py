"""``robocas convert``: write a dataset from recorded episodes."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import tyro

if TYPE_CHECKING:
    from robocas_ms3.datasets.formats import Format
    from robocas_ms3.datasets.writing.settings import Conversion

from robocas_ms3.cli.interrupts import resumable
from robocas_ms3.cli.options import Maybe, Several
from robocas_ms3.datasets.lerobot.variants import NEWEST, Version


@dataclass
class Convert:
    """Render a trajectory file of `robocas generate` into a dataset, or turn a RoboCAS dataset into a LeRobot dataset.

    Example: robocas convert demos/pick/trajectory.h5 --out datasets/pick --jobs 2
    """

    trajectory: Annotated[Path, tyro.conf.Positional]
    """F.h5, with F.json next to it. With --to lerobot also the folder of a RoboCAS dataset, whose images are used."""
    out: Path
    """Folder of the dataset."""
    to: str = "robocas"
    """Format of the dataset: robocas, lerobot (needs the extra 'lerobot'), or one of another package."""
    lerobot_version: Version = NEWEST
    """Reader of the LeRobot dataset. 0.6: LeRobot 0.6 and later (format v3.0, language columns, depth as video);
    0.5: LeRobot 0.4.4 to 0.5.1 (v3.0, subtask_index); 2.1: readers of format v2.1, such as openpi and GR00T."""
    codec: Literal["h264", "av1"] = "h264"
    """Codec of the videos of a LeRobot dataset; AV1 takes half the space."""
    rate: Maybe[float] = None
    """Steps per second; must divide the control frequency. Default: 5, or the rate of the RoboCAS dataset."""
    embeddings: bool = True
    """Embed instruction and sub-goals (needs the extra 'language'; not for lerobot)."""
    video: bool = True
    """Write a video of each episode and a contact sheet into OUT/preview, if there are at most 20 episodes (not for
    lerobot)."""
    all_videos: bool = False
    """Write videos and contact sheet of more than 20 episodes too."""
    cameras: Several[str] = ()
    """Cameras to render, or to take from the dataset. Default: all that there are."""
    size: Maybe[tuple[int, int]] = None
    """Width and height of the images. Default: those of the cameras, 640 480."""
    depth: bool = True
    """Store depth in addition to RGB."""
    image_format: Literal["png", "jpg", "webp"] = "png"
    """Format of RGB images; the loader released with RoboCAS opens png only. Not for lerobot, which stores videos."""
    include_failed: bool = False
    """Also convert episodes without success."""
    overwrite: bool = False
    """Start again. Default: continue a conversion with the same settings that was interrupted."""
    append: bool = False
    """Add to the dataset that is there; its episodes keep their numbers."""
    leave_out: bool = False
    """Warn of episodes that can't be written, in place of an error in the end; LeRobot datasets are joined without."""
    jobs: int = 1
    """Processes that render."""
    episode_seconds: float = 3600.0
    """Seconds that an episode may take. An episode that takes longer, needs more memory or crashes its process is
    retried once, then skipped and named at the end, like one that can't be rendered or stored."""
    memory_gb: float = 8.0
    """GB of memory that a process may use."""
    pack: Maybe[str] = None
    """Object pack to use instead of the recorded one: its name, or its folder."""


@resumable
def main(cfg: Convert) -> int:
    """Convert, with a progress bar; gives the exit code."""
    _check(cfg)
    return _convert(cfg)


def _check(cfg: Convert) -> None:
    from robocas_ms3.core.errors import DatasetError

    if cfg.overwrite and cfg.append:
        found = "--overwrite --append"
        raise DatasetError("these exclude each other", where="convert", expected="one of them", found=found)
    if cfg.all_videos and not cfg.video:
        raise DatasetError(
            "these exclude each other", where="convert", expected="one of them", found="--no-video --all-videos"
        )
    if cfg.jobs < 1:
        raise DatasetError("not a number of processes", where="--jobs", expected="1 or more", found=cfg.jobs)
    if not (cfg.episode_seconds >= 1 and cfg.memory_gb > 0):
        found = f"--episode-seconds {cfg.episode_seconds:g} --memory-gb {cfg.memory_gb:g}"
        raise DatasetError("no episode can be written within that", where="convert", found=found)
    if len(set(cfg.cameras)) < len(cfg.cameras):
        found = " ".join(cfg.cameras)
        raise DatasetError("a camera is named twice", where="--cameras", expected="each once", found=found)


def _format(cfg: Convert) -> Format:
    """What is written.

    Raises:
        ExtensionError: there is no such format.
        DatasetError: a flag does not suit it.
    """
    from robocas_ms3.core.errors import DatasetError
    from robocas_ms3.core.strict import nearest
    from robocas_ms3.datasets.formats import FORMATS

    writable = [name for name, known in FORMATS.items() if known.writer]
    if cfg.to not in writable:
        expected, fix = f"one of {writable}", nearest(cfg.to, writable)
        raise DatasetError("no such dataset format to write", where="--to", expected=expected, found=cfg.to, fix=fix)
    chosen = FORMATS[cfg.to]
    flags = {
        "append": cfg.append,
        "leave_out": cfg.leave_out,
        "image_format": cfg.image_format != "png",
        "codec": cfg.codec != "h264",
        "lerobot_version": cfg.lerobot_version != NEWEST,
    }
    for option, given in flags.items():
        if given and option not in chosen.options:
            flag = f"--{option.replace('_', '-')}"
            raise DatasetError(f"not for {chosen.title}s", where=flag, fix="Leave it out.")
    return chosen


def _convert(cfg: Convert) -> int:
    from robocas_ms3.cli.bars import bar
    from robocas_ms3.cli.terminal import say
    from robocas_ms3.core.words import count_of
    from robocas_ms3.core.workers import Limits
    from robocas_ms3.datasets.pictures.stored import Pictures
    from robocas_ms3.datasets.writing.settings import ConversionSettings

    chosen = _format(cfg)
    settings = ConversionSettings(
        cfg.trajectory,
        cfg.out,
        rate_hz=cfg.rate,
        pictures=Pictures(cfg.cameras, cfg.size, cfg.depth, cfg.image_format),
        include_failed=cfg.include_failed,
        pack=cfg.pack,
        overwrite=cfg.overwrite,
        append=cfg.append,
        leave_out=cfg.leave_out,
        embeddings=cfg.embeddings,
        previews=(True if cfg.all_videos else None) if cfg.video else False,
        codec=cfg.codec,
        lerobot_version=cfg.lerobot_version,
        jobs=cfg.jobs,
        limits=Limits(cfg.episode_seconds, cfg.memory_gb),
    )
    with bar("episodes written") as shown:
        write: Callable[..., Conversion] = chosen.part("writer")
        done = write(settings, on_start=shown.start, on_episode=shown.advance)
    count = len(done.episodes)
    said = [f"{cfg.out}: {count_of(count, 'episode')}"] + ([f"{done.kept} kept"] if done.kept else [])
    if count:
        megabytes = sum(episode.size for episode in done.episodes) / 1e6
        steps = count_of(sum(episode.steps for episode in done.episodes), "step")
        said += [steps, f"{megabytes:.0f} MB", f"{done.seconds / count:.1f} s an episode"]
    say(", ".join(said))
    if count:
        say(parts(done, cfg))
    if count and cfg.video and cfg.to == "robocas" and not done.previews:
        say("no videos of so many episodes: --all-videos makes them, and robocas video those of some")
    return 0


def parts(done: Conversion, cfg: Convert) -> str:
    """Where the time of an episode went, in the process that wrote it."""
    spent, count = done.timing, len(done.episodes)
    beside = ""
    if cfg.to == "robocas":
        waited = f", which waited {spent.wait / count:.1f}" if spent.wait / count >= 0.05 else ""
        beside = f" (beside rendering{waited})"
    processes = min(cfg.jobs, count)
    shared = f", {processes} at a time" if processes > 1 else ""
    return (
        f"load {spent.load / count:.1f}, render {spent.render / count:.1f}, encode {spent.encode / count:.1f}{beside},"
        f" write {spent.write / count:.1f} s an episode{shared}"
    )
