"""What each address of the viewer gives. No part of an address ever becomes a path: numbers and known names only.

::

    /                                        the page
    /page/NAME                               its scripts and style
    /data/index.js, /data/episode_12.js      robocas.put("index", {...})
    /pictures/12/base_camera/rgb/30.jpg      a picture; depth in colours
    /thumbnails/12.jpg

Data travel as scripts, so that the same page also works from files, where a browser fetches nothing. The page asks for
pictures with a query that tells this server from others: a browser keeps them, and what is served at this port later
may be another dataset.
"""

from __future__ import annotations

import json
import re
import secrets
import threading
from dataclasses import dataclass
from functools import lru_cache, partial
from importlib.resources import files
from typing import Any

from robocas_ms3.core.errors import DatasetError
from robocas_ms3.core.words import printable
from robocas_ms3.viewer import pictures
from robocas_ms3.viewer.content import CAMERA_NAME, PageContent
from robocas_ms3.viewer.damage import without_nan
from robocas_ms3.viewer.pictures import Picture

PAGE_FILES = {
    "index.html": "text/html; charset=utf-8",
    "style.css": "text/css; charset=utf-8",
    "icon.svg": "image/svg+xml",
    **{
        f"{name}.js": "text/javascript; charset=utf-8"
        for name in ("data", "table", "plots", "space", "player", "episode", "main")
    },
}
_NUMBER = r"(0|[1-9][0-9]{0,8})"
_INDEX = re.compile(r"/data/index\.js")
_EPISODE = re.compile(rf"/data/episode_{_NUMBER}\.js")
_PICTURE = re.compile(rf"/pictures/{_NUMBER}/({CAMERA_NAME.pattern})/(rgb|depth)/{_NUMBER}\.jpg")
_THUMBNAIL = re.compile(rf"/thumbnails/{_NUMBER}\.jpg")
_CONTROL = re.compile(  # of `words.printable`, but for surrogates, of which JSON makes emoji
    r"(?<!\\)((?:\\\\)*)\\(u(?:00[01].|007f|00[89].|061c|200[ef]|202[89a-e]|206[6-9]))"
)
_SCRIPT = "text/javascript; charset=utf-8"


@dataclass(frozen=True)
class Response:
    """What to send: status, media type, content, and for how many seconds a browser may keep it."""

    status: int
    kind: str
    data: bytes
    keep_s: int = 0


class Routes:
    """Answers of one source; may be asked from several threads."""

    def __init__(self, source: PageContent) -> None:
        self.source = source
        self.version = secrets.token_hex(4)
        self._index: dict[str, Any] | None = None
        self._script = b""
        self._making = threading.Lock()
        self._thumbnail = lru_cache(maxsize=4096)(lambda number: make_thumbnail(source, self.index, number))

    @property
    def index(self) -> dict[str, Any]:
        """Of the source, made once."""
        with self._making:
            if self._index is None:
                self._index = self.source.index()
                self._script = script("index", {**self._index, "version": self.version})
            return self._index

    def respond(self, path: str) -> Response:
        """Answer an address, already without its query."""
        if path in ("/", "/index.html"):
            return Response(200, PAGE_FILES["index.html"], page_file("index.html"))
        if path.startswith("/page/") and path[6:] in PAGE_FILES:
            return Response(200, PAGE_FILES[path[6:]], page_file(path[6:]))
        try:
            return self._data(path) or _not_found("nothing here")
        except DatasetError as error:
            return _not_found(str(error))

    def _data(self, path: str) -> Response | None:
        if _INDEX.fullmatch(path):
            _ = self.index
            return Response(200, _SCRIPT, self._script)
        if match := _EPISODE.fullmatch(path):
            number = int(match[1])
            return Response(200, _SCRIPT, script(f"episode_{number}", self.source.episode(number)))
        if match := _THUMBNAIL.fullmatch(path):
            return _picture(self._thumbnail(int(match[1])))
        if match := _PICTURE.fullmatch(path):
            number, camera, kind, step = int(match[1]), match[2], match[3], int(match[4])
            if camera not in self.index["cameras"]:
                return None
            if kind == "rgb":
                return _picture(self.source.rgb(number, camera, step))
            return _picture(pictures.depth_picture(self.source.depth(number, camera, step)))
        return None


def make_thumbnail(source: PageContent, index: dict[str, Any], number: int) -> Picture:
    """The first step as the camera sees it that shows most: the static one where there is one.

    Raises:
        DatasetError: no such episode, or no pictures.
    """
    cameras = index["cameras"]
    if not cameras:
        raise DatasetError("no pictures", where=source.root)
    camera = next((name for name in cameras if "static" in name), cameras[0])
    return pictures.thumbnail(source.rgb(number, camera, 0))


def script(name: str, content: Any) -> bytes:
    """Content as a script that hands it to the page."""
    write = partial(json.dumps, ensure_ascii=True, separators=(",", ":"), allow_nan=False, default=str)
    try:
        text = write(content)
    except ValueError:
        text = write(without_nan(content))
    return f'robocas.put("{name}",{_shown(text)});\n'.encode()


def _shown(json_text: str) -> str:
    r"""JSON of ASCII whose control characters a page shows as escapes: ``\u202e`` becomes ``\\u202e``."""
    return _CONTROL.sub(r"\1\\\\\2", json_text)


def page_file(name: str) -> bytes:
    """One of the page's files."""
    return files("robocas_ms3.viewer").joinpath("page", name).read_bytes()


def _picture(picture: Picture) -> Response:
    return Response(200, picture.kind, picture.data, keep_s=600)


def _not_found(why: str) -> Response:
    return Response(404, "text/plain; charset=utf-8", (printable(why) + "\n").encode())
