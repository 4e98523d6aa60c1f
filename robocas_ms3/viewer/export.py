"""Export of the viewer as a folder that opens from disk, without a server."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from typing import Any

from robocas_ms3.core.errors import DatasetError
from robocas_ms3.core.files import atomic_folder, make_folder
from robocas_ms3.core.text import format_ranges
from robocas_ms3.viewer.content import Content
from robocas_ms3.viewer.damage import convert_damage_errors, describe_error, join_reasons
from robocas_ms3.viewer.images import EncodedImage, render_depth, shrink_image
from robocas_ms3.viewer.routes import PAGE_FILES, make_script, make_thumbnail, read_page_file


def export(
    source: Content,
    out: Path,
    *,
    episodes: Sequence[int] = (),
    width: int = 480,
    depth: bool = True,
    on_episode: Callable[[int, int], None] = lambda done, total: None,
) -> tuple[int, dict[int, str]]:
    """Write the page with its data and images to a folder; an existing folder is replaced without a check.

    Args:
        source: content of the page.
        out: output folder; ``index.html`` in it opens from disk.
        episodes: numbers of the episodes; empty: all.
        width: maximum width of the images in pixels.
        depth: whether to write depth images.
        on_episode: called with (episodes done, all episodes).

    Returns:
        The number of written episodes, and a text on the damage per number of a damaged episode.

    Raises:
        DatasetError: one of ``episodes`` does not exist.
    """
    index = source.index()
    known = [entry["n"] for entry in index["episodes"] if entry["n"] is not None]
    missing = sorted(set(episodes) - set(known))
    if missing:
        expected, found = format_ranges(known), format_ranges(missing)
        what = "no such decision" if index.get("decisions") else "no such episode"
        raise DatasetError(what, where=source.root, expected=expected, found=found, usage=True)
    chosen = [number for number in known if not episodes or number in set(episodes)]
    rows = [e for e in index["episodes"] if e["n"] in set(chosen) or (e["n"] is None and not episodes)]
    index = {**index, "depth": index["depth"] and depth}
    damaged = {row["n"]: row["damage"] for row in rows if row["damage"]}
    with atomic_folder(out) as folder:
        for name in PAGE_FILES:
            target = folder / name if name == "index.html" else make_folder(folder / "page") / name
            target.write_bytes(read_page_file(name))
        make_folder(folder / "data")
        for done, number in enumerate(chosen):
            on_episode(done, len(chosen))
            wrong = _write_episode(source, index, number, folder, width)
            if wrong:
                damaged[number] = join_reasons(damaged.get(number, ""), wrong)
        index["episodes"] = [{**row, "damage": damaged.get(row["n"], "")} for row in rows]
        (folder / "data" / "index.js").write_bytes(make_script("index", index))
        on_episode(len(chosen), len(chosen))
    return len(chosen), damaged


def _write_episode(source: Content, index: dict[str, Any], number: int, folder: Path, width: int) -> str:
    lost = ""
    if index["cameras"]:
        lost = _write(folder / "thumbnails" / f"{number}.jpg", lambda: make_thumbnail(source, index, number))
    try:
        content = source.episode(number)
    except DatasetError as error:
        return describe_error(error)
    (folder / "data" / f"episode_{number}.js").write_bytes(make_script(f"episode_{number}", content))
    make = {"rgb": lambda *place: shrink_image(source.rgb(number, *place), width)}
    if index["depth"]:
        make["depth"] = lambda *place: render_depth(source.depth(number, *place), width)
    for camera in index["cameras"]:
        for step in range(content["steps"]):
            for kind, image in make.items():
                path = folder / "images" / str(number) / camera / kind / f"{step}.jpg"
                lost = _write(path, partial(image, camera, step)) or lost
    return lost


def _write(path: Path, make: Callable[[], EncodedImage]) -> str:
    """Write the image that ``make`` returns; return "", or a text on the damage if the image is damaged."""
    try:
        with convert_damage_errors(path.name):
            image = make()
    except DatasetError as error:
        return f"images: {error.what}"
    (make_folder(path.parent) / path.name).write_bytes(image.data)
    return ""
