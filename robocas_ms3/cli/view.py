"""``robocas view``: show a dataset, a trajectory file or decisions with candidates in a browser."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro

from robocas_ms3.cli.options import Maybe, Several
from robocas_ms3.core.errors import DatasetError
from robocas_ms3.core.text import format_count


@dataclass
class View:
    """Show a trajectory file, a candidates.h5, a RoboCAS folder or a LeRobot dataset in a browser.

    Example: robocas view datasets/pick
    """

    path: Annotated[Path, tyro.conf.Positional]
    """A trajectory.h5 (with trajectory.json next to it), a candidates.h5, or the folder of a dataset."""
    port: int = 0
    """Port on 127.0.0.1; 0 chooses a free port."""
    open: bool = True
    """Open the page in the default browser."""
    static: Maybe[Path] = None
    """Write a static page to this folder instead of starting a server. Open PATH/index.html in a browser."""
    episodes: Several[int] = ()
    """With --static: episode numbers, or row numbers of decisions. Default: all."""
    width: Maybe[int] = None
    """With --static: maximum width of the images in pixels. Default: 480; for candidates.h5 no limit."""
    depth: bool = True
    """With --static: also write depth images."""
    overwrite: bool = False
    """With --static: replace an existing folder."""
    images: Maybe[Path] = None
    """With a candidates.h5: file of robocas render-candidates.
    Default: candidates_images.h5 next to it; without images, the page shows plots from above."""
    sheet: Maybe[Path] = None
    """With a candidates.h5: write a contact sheet to this PNG or JPEG file instead of starting a server."""
    decisions: int = 20
    """With --sheet: number of decisions; they are spread over the kinds of decisions and over the file."""
    camera: Maybe[str] = None
    """With --sheet: name of a camera, or top_view for plots from above.
    Default: per decision, the camera that shows most candidates."""


def main(cfg: View) -> int:
    from robocas_ms3.cli.terminal import print_line
    from robocas_ms3.viewer.decisions.content import DecisionContent
    from robocas_ms3.viewer.source import open_content

    source = open_content(cfg.path, images=cfg.images)
    if isinstance(source, DecisionContent) and source.source.note:
        print_line(source.source.note.replace("`", ""))
    if cfg.sheet is not None:
        return _write_sheet(cfg, cfg.sheet, source)
    if cfg.static is not None:
        return _write(cfg, cfg.static, source)
    import signal
    import webbrowser

    from robocas_ms3.viewer.server import Viewer

    with Viewer(source, cfg.port) as server:
        server.warm_up()
        print_line(f"{cfg.path} at {server.url} (press Ctrl-C to stop)")
        # SIGTERM stops the server like Ctrl-C; shells let background processes ignore SIGINT
        for number in (signal.SIGTERM, signal.SIGINT):
            signal.signal(number, signal.default_int_handler)
        if cfg.open:
            webbrowser.open(server.url)
        try:
            server.serve_forever(poll_interval=0.1)
        except KeyboardInterrupt:
            print_line("stopped")
    return 0


def _write_sheet(cfg: View, out: Path, content) -> int:
    from robocas_ms3.cli.terminal import print_line
    from robocas_ms3.viewer.decisions.content import DecisionContent
    from robocas_ms3.viewer.decisions.sheet import write_sheet

    if not isinstance(content, DecisionContent):
        expected, fix = "a candidates.h5", "Contact sheets of datasets are written by robocas video."
        raise DatasetError("not a file of candidates", where=cfg.path, expected=expected, fix=fix, usage=True)
    if cfg.decisions < 1:
        expected = "1 or more decisions"
        raise DatasetError("invalid number", where="--decisions", expected=expected, found=cfg.decisions, usage=True)
    rows = write_sheet(content.source, out, count=cfg.decisions, camera=cfg.camera)
    print_line(f"wrote {out}: {format_count(len(rows), 'decision')}")
    return 0


def _write(cfg: View, out: Path, source) -> int:
    from robocas_ms3.cli.progress import ProgressBar
    from robocas_ms3.cli.terminal import print_line
    from robocas_ms3.core.output_folder import check_replaceable
    from robocas_ms3.datasets.images.image_headers import LARGEST
    from robocas_ms3.viewer.decisions.content import DecisionContent
    from robocas_ms3.viewer.export import export

    check_replaceable(out, overwrite=cfg.overwrite, markers=("data/index.js",))
    decisions = isinstance(source, DecisionContent)
    noun = "decision" if decisions else "episode"
    with ProgressBar(f"{noun}s written", transient=True) as bar:
        count, damaged = export(
            source,
            out,
            episodes=cfg.episodes,
            width=cfg.width or (LARGEST if decisions else 480),
            depth=cfg.depth,
            on_episode=bar.update,
        )
    for number, wrong in damaged.items():
        print_line(f"{noun} {number} is damaged: {wrong}")
    print_line(f"wrote {out / 'index.html'}: {format_count(count, noun)}")
    return 0
