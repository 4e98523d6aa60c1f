"""Writes the viewer as a folder that opens from disk, without a server."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from robocas_ms3.errors import DatasetError
from robocas_ms3.files import make_folder, replacing_folder
from robocas_ms3.viewer import pictures
from robocas_ms3.viewer.routes import PAGE_FILES, make_thumbnail, page_file, script
from robocas_ms3.viewer.source import Picture, Source

WIDTH = 480
"""Pixels of a written picture; a static page is for sharing, so it is kept small."""


def export(
    source: Source,
    out: Path,
    *,
    episodes: Sequence[int] = (),
    width: int = WIDTH,
    depth: bool = True,
    on_episode: Callable[[int, int], None] = lambda done, all: None,
) -> int:
    """Write ``index.html`` and all it needs; gives the number of episodes.

    Args:
        source: what to show.
        out: folder; one that exists is replaced whole, so the caller makes sure that it may be.
        episodes: numbers; default: all.
        width: of the pictures, pixels.
        depth: whether depth is written too.
        on_episode: told (done, all).

    Raises:
        DatasetError: an episode is not there or can't be read.
    """
    index = source.index()
    known = [entry["n"] for entry in index["episodes"] if entry["n"] is not None]
    missing = sorted(set(episodes) - set(known))
    if missing:
        raise DatasetError("no such episode", where=source.root, expected=f"{known[:1]} to {known[-1:]}", found=missing)
    chosen = [number for number in known if not episodes or number in set(episodes)]
    index = {**index, "depth": index["depth"] and depth}
    index["episodes"] = [e for e in index["episodes"] if e["n"] in set(chosen) or (e["n"] is None and not episodes)]
    with replacing_folder(out) as folder:
        for name in PAGE_FILES:
            target = folder / name if name == "index.html" else make_folder(folder / "page") / name
            target.write_bytes(page_file(name))
        make_folder(folder / "data")
        (folder / "data" / "index.js").write_bytes(script("index", index))
        for done, number in enumerate(chosen):
            on_episode(done, len(chosen))
            _write_episode(source, index, number, folder, width)
        on_episode(len(chosen), len(chosen))
    return len(chosen)


def _write_episode(source: Source, index: dict[str, Any], number: int, folder: Path, width: int) -> None:
    content = source.episode(number)
    (folder / "data" / f"episode_{number}.js").write_bytes(script(f"episode_{number}", content))
    if not index["cameras"]:
        return
    _write(make_folder(folder / "thumbnails") / f"{number}.jpg", make_thumbnail(source, index, number))
    for camera in index["cameras"]:
        place = folder / "pictures" / str(number) / camera
        for step in range(content["steps"]):
            rgb = pictures.shrunk(source.rgb(number, camera, step), width)
            _write(make_folder(place / "rgb") / f"{step}.jpg", rgb)
            if index["depth"]:
                coloured = pictures.depth_picture(source.depth(number, camera, step), width)
                _write(make_folder(place / "depth") / f"{step}.jpg", coloured)


def _write(path: Path, picture: Picture) -> None:
    path.write_bytes(picture.data)
