"""Looks at the pictures of an episode made elsewhere: headers and checksums."""

from __future__ import annotations

from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

from robocas_ms3.datasets.manage.findings import FULL_SIZE, Layout, Report
from robocas_ms3.datasets.pictures.headers import PictureHeader, read_header
from robocas_ms3.datasets.sources.reader import Episode
from robocas_ms3.datasets.statistics.described import count_of

_MOST = 3  # problems named of one camera's pictures
_READERS = 4  # threads: reading and checksums happen outside Python's lock


def check_pictures(episode: Episode, steps: int, report: Report) -> Layout | None:
    """Check that every step has its pictures, whole and of one size a camera; what is wrong is reported."""
    sizes: set[tuple[int, int]] = set()
    for camera in episode.cameras:
        headers: set[PictureHeader] = set()
        for kind in ("rgb", "depth") if episode.has_depth else ("rgb",):
            problems = list(_pictures_of(episode, camera, kind, steps, headers, report))
            for place, problem in problems[:_MOST]:
                report.bad(place, problem)
            if len(problems) > _MOST:
                report.bad(f"{camera}/{kind}", f"{len(problems) - _MOST} more are missing or damaged")
        found = {(header.width, header.height) for header in headers}
        if len(found) > 1:
            report.bad(camera, "pictures of different sizes: " + ", ".join(f"{w} x {h}" for w, h in sorted(found)))
        sizes |= found
    if not report.usable:
        return None
    size = sizes.pop() if len(sizes) == 1 else FULL_SIZE
    return Layout(episode.cameras, episode.has_depth, episode.image_format, None if size == FULL_SIZE else size)


def _pictures_of(
    episode: Episode, camera: str, kind: str, steps: int, headers: set[PictureHeader], report: Report
) -> Iterator[tuple[str, str]]:
    """(file, problem) of one camera's RGB or depth."""
    wanted = {"rgb": (8, 3), "depth": (16, 1)}[kind]
    paths = [episode.image_path(camera, kind, step) for step in range(steps)]
    with ThreadPoolExecutor(_READERS) as pool:
        for path, header in zip(paths, pool.map(_header, paths), strict=True):
            place = f"{camera}/{kind}/{path.name}"
            if isinstance(header, str):
                yield place, header
                continue
            headers.add(PictureHeader(header.width, header.height, 0, 0))
            if (header.bits, header.channels) != wanted:
                yield place, f"{header.channels} x {header.bits} bit, not {wanted[1]} x {wanted[0]} bit"
    folder = episode.folder / camera / kind
    extra = {path.name for path in folder.iterdir()} - {path.name for path in paths} if folder.is_dir() else set()
    if extra:
        report.noted(
            f"{camera}/{kind}", f"{count_of(len(extra), 'file')} beyond the {count_of(steps, 'step')}: not taken"
        )


def _header(path: Path) -> PictureHeader | str:
    """A picture's header, or what is wrong with it."""
    try:
        return read_header(path)
    except FileNotFoundError:
        return "missing"
    except (OSError, ValueError) as error:
        return str(error)
