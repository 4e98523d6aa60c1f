"""``robocas view``: show a dataset or a trajectory file in a browser."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro

from robocas_ms3.cli.options import Maybe, Several
from robocas_ms3.core.text import format_count


@dataclass
class View:
    """Show a trajectory file, a RoboCAS folder or a LeRobot dataset in a browser.

    Example: robocas view datasets/pick
    """

    path: Annotated[Path, tyro.conf.Positional]
    """A trajectory.h5 (with trajectory.json next to it), or the folder of a dataset."""
    port: int = 0
    """Port on 127.0.0.1; 0 chooses a free port."""
    open: bool = True
    """Open the page in the default browser."""
    static: Maybe[Path] = None
    """Write a static page to this folder instead of starting a server. Open PATH/index.html in a browser."""
    episodes: Several[int] = ()
    """With --static: episode numbers. Default: all."""
    width: int = 480
    """With --static: width of the images in pixels."""
    depth: bool = True
    """With --static: also write depth images."""
    overwrite: bool = False
    """With --static: replace an existing folder."""


def main(cfg: View) -> int:
    from robocas_ms3.cli.terminal import print_line
    from robocas_ms3.viewer.source import open_content

    source = open_content(cfg.path)
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


def _write(cfg: View, out: Path, source) -> int:
    from robocas_ms3.cli.progress import ProgressBar
    from robocas_ms3.cli.terminal import print_line
    from robocas_ms3.core.output_folder import check_replaceable
    from robocas_ms3.viewer.export import export

    check_replaceable(out, overwrite=cfg.overwrite, markers=("data/index.js",))
    with ProgressBar("episodes written", transient=True) as bar:
        count, damaged = export(
            source,
            out,
            episodes=cfg.episodes,
            width=cfg.width,
            depth=cfg.depth,
            on_episode=bar.update,
        )
    for number, wrong in damaged.items():
        print_line(f"episode {number} is damaged: {wrong}")
    print_line(f"wrote {out / 'index.html'}: {format_count(count, 'episode')}")
    return 0
