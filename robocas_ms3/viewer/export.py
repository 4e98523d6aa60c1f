"""Export of the viewer as a folder that opens from disk, without a server."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from typing import Any

from robocas_ms3.core.errors import DatasetError
from robocas_ms3.core.files import atomic_folder, make_folder
from robocas_ms3.core.text import format_ranges
from robocas_ms3.viewer.content import PageContent
from robocas_ms3.viewer.damage import as_dataset_error, join_reasons, reason
from robocas_ms3.viewer.images import EncodedImage, depth_image, shrink_image
from robocas_ms3.viewer.routes import PAGE_FILES, make_thumbnail, page_file, script


def export(
    source: PageContent,
    out: Path,
    *,
    episodes: Sequence[int] = (),
    width: int = 480,
    depth: bool = True,
    on_episode: Callable[[int, int], None] = lambda done, total: None,
) -> tuple[int, dict[int, str]]:
    """Write ``index.html`` and its files; an existing folder is replaced without a check.

    Return the number of episodes, and a text on each damaged episode by number. Raise DatasetError if a requested
    episode does not exist. ``on_episode`` is called with (done, total).
    """
    index = source.index()
    known = [entry["n"] for entry in index["episodes"] if entry["n"] is not None]
    missing = sorted(set(episodes) - set(known))
    if missing:
        expected, found = format_ranges(known), format_ranges(missing)
        raise DatasetError("no such episode", where=source.root, expected=expected, found=found, usage=True)
    chosen = [number for number in known if not episodes or number in set(episodes)]
    rows = [e for e in index["episodes"] if e["n"] in set(chosen) or (e["n"] is None and not episodes)]
    index = {**index, "depth": index["depth"] and depth}
    damaged = {row["n"]: row["damage"] for row in rows if row["damage"]}
    with atomic_folder(out) as folder:
        for name in PAGE_FILES:
            target = folder / name if name == "index.html" else make_folder(folder / "page") / name
            target.write_bytes(page_file(name))
        make_folder(folder / "data")
        for done, number in enumerate(chosen):
            on_episode(done, len(chosen))
            wrong = _write_episode(source, index, number, folder, width)
            if wrong:
                damaged[number] = join_reasons(damaged.get(number, ""), wrong)
        index["episodes"] = [{**row, "damage": damaged.get(row["n"], "")} for row in rows]
        (folder / "data" / "index.js").write_bytes(script("index", index))
        on_episode(len(chosen), len(chosen))
    return len(chosen), damaged


def _write_episode(source: PageContent, index: dict[str, Any], number: int, folder: Path, width: int) -> str:
    lost = ""
    if index["cameras"]:
        lost = _write(folder / "thumbnails" / f"{number}.jpg", lambda: make_thumbnail(source, index, number))
    try:
        content = source.episode(number)
    except DatasetError as error:
        return reason(error)
    (folder / "data" / f"episode_{number}.js").write_bytes(script(f"episode_{number}", content))
    make = {"rgb": lambda *place: shrink_image(source.rgb(number, *place), width)}
    if index["depth"]:
        make["depth"] = lambda *place: depth_image(source.depth(number, *place), width)
    for camera in index["cameras"]:
        for step in range(content["steps"]):
            for kind, image in make.items():
                path = folder / "images" / str(number) / camera / kind / f"{step}.jpg"
                lost = _write(path, partial(image, camera, step)) or lost
    return lost


def _write(path: Path, make: Callable[[], EncodedImage]) -> str:
    """Write an image; return the reason if that fails, an empty text otherwise."""
    try:
        with as_dataset_error(path.name):
            image = make()
    except DatasetError as error:
        return f"images: {error.what}"
    (make_folder(path.parent) / path.name).write_bytes(image.data)
    return ""
