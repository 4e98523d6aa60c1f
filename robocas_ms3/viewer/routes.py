"""Responses of the viewer by URL. URLs contain only numbers and known names, never paths.

::

    /                                        the page
    /page/NAME                               its scripts and style
    /data/index.js, /data/episode_12.js      robocas.put("index", {...})
    /images/12/base_camera/rgb/30.jpg        an image; depth in colours
    /thumbnails/12.jpg

Data are scripts, so that the page also works from disk, where browsers block requests. URLs of images have a query
that identifies the server, because browsers cache images and another dataset may use the same port later.
"""

from __future__ import annotations

import json
import re
import secrets
import threading
from dataclasses import dataclass
from functools import cached_property, lru_cache
from importlib.resources import files
from typing import Any

from robocas_ms3.core.errors import DatasetError
from robocas_ms3.core.text import escape_controls
from robocas_ms3.viewer import images
from robocas_ms3.viewer.content import CAMERA_NAME, Content
from robocas_ms3.viewer.images import EncodedImage

_SCRIPT = "text/javascript; charset=utf-8"
PAGE_FILES = {
    "index.html": "text/html; charset=utf-8",
    "style.css": "text/css; charset=utf-8",
    "icon.svg": "image/svg+xml",
    **{f"{name}.js": _SCRIPT for name in ("data", "table", "plots", "space", "player", "episode", "decision", "main")},
}
_NUMBER = r"(0|[1-9][0-9]{0,8})"
_EPISODE = re.compile(rf"/data/episode_{_NUMBER}\.js")
_IMAGE = re.compile(rf"/images/{_NUMBER}/({CAMERA_NAME.pattern})/(rgb|depth)/{_NUMBER}\.jpg")
_THUMBNAIL = re.compile(rf"/thumbnails/{_NUMBER}\.jpg")
_CONTROL = re.compile(  # of `text.escape_controls`, but for surrogates, of which JSON makes emoji
    r"(?<!\\)((?:\\\\)*)\\(u(?:00[01].|007f|00[89].|061c|200[ef]|202[89a-e]|206[6-9]))"
)


@dataclass(frozen=True)
class Response:
    """HTTP response; a browser may cache it for ``max_age`` seconds."""

    status: int
    media_type: str
    data: bytes
    max_age: int = 0


class Routes:
    """Responses of the HTTP server for one dataset; the methods are thread-safe."""

    def __init__(self, source: Content) -> None:
        self.source = source
        self.version = secrets.token_hex(4)
        self._making = threading.Lock()
        self._thumbnail = lru_cache(maxsize=4096)(lambda number: make_thumbnail(source, self.index, number))

    @property
    def index(self) -> dict[str, Any]:
        with self._making:
            return self._index

    @cached_property
    def _index(self) -> dict[str, Any]:
        return self.source.index()

    def respond(self, path: str) -> Response:
        """Return the response for the path of a URL; status 404 for an unknown path or damaged data."""
        name = "index.html" if path in ("/", "/index.html") else path.removeprefix("/page/")
        if name in PAGE_FILES and (path.startswith("/page/") or name == "index.html"):
            return Response(200, PAGE_FILES[name], read_page_file(name))
        try:
            return self._data(path) or _not_found("not found")
        except DatasetError as error:
            return _not_found(str(error))

    def _data(self, path: str) -> Response | None:
        if path == "/data/index.js":
            return Response(200, _SCRIPT, make_script("index", {**self.index, "version": self.version}))
        if match := _EPISODE.fullmatch(path):
            number = int(match[1])
            return Response(200, _SCRIPT, make_script(f"episode_{number}", self.source.episode(number)))
        if match := _THUMBNAIL.fullmatch(path):
            return _image(self._thumbnail(int(match[1])))
        if match := _IMAGE.fullmatch(path):
            number, camera, kind, step = int(match[1]), match[2], match[3], int(match[4])
            if camera not in self.index["cameras"]:
                return None
            if kind == "rgb":
                return _image(self.source.rgb(number, camera, step))
            return _image(images.render_depth(self.source.depth(number, camera, step)))
        return None


def make_thumbnail(source: Content, index: dict[str, Any], number: int) -> EncodedImage:
    """Return a thumbnail of the first image of an episode, from the static camera if there is one."""
    cameras = index["cameras"]
    if not cameras:
        raise DatasetError("this dataset has no images", where=source.root)
    camera = next((name for name in cameras if "static" in name), cameras[0])
    return images.shrink_to_thumbnail(source.rgb(number, camera, 0))


def make_script(name: str, content: Any) -> bytes:
    r"""Return a JavaScript file that passes JSON content to the page under a name.

    The script is ASCII. Control characters are escaped for display: ``\u202e`` becomes ``\\u202e``.
    """
    text = json.dumps(content, ensure_ascii=True, separators=(",", ":"), default=str)
    shown = _CONTROL.sub(r"\1\\\\\2", text)
    return f'robocas.put("{name}",{shown});\n'.encode()


def read_page_file(name: str) -> bytes:
    return files("robocas_ms3.viewer").joinpath("page", name).read_bytes()


def _image(image: EncodedImage) -> Response:
    return Response(200, image.media_type, image.data, max_age=600)


def _not_found(why: str) -> Response:
    return Response(404, "text/plain; charset=utf-8", (escape_controls(why) + "\n").encode())
