"""Videos with PyAV: encoding, joining without encoding again, reading by frame, depth videos.

The native depth of LeRobot 0.6 and later has 12-bit levels. Here a level is 1 mm: depth up to 4095 mm is exact, larger
depth is stored as 4095 mm.
"""

from __future__ import annotations

import errno
import os
from collections.abc import Callable, Generator, Mapping
from contextlib import suppress
from dataclasses import dataclass, field
from fractions import Fraction
from itertools import islice
from pathlib import Path
from typing import Annotated, Any

import av
import numpy as np
from av.error import FFmpegError
from numpy.typing import NDArray
from pydantic import BaseModel, ConfigDict, Field, model_validator

from robocas_ms3.core.documents import DocumentError, check_regular_file
from robocas_ms3.core.errors import DatasetError
from robocas_ms3.core.strict_model import parse
from robocas_ms3.datasets.lerobot.schema import MAX_DEPTH_MM, check_video_size
from robocas_ms3.datasets.lerobot.variants import CHUNK_FILES, Variant
from robocas_ms3.datasets.sources.episode_source import ImageKind


@dataclass(frozen=True)
class VideoCodec:
    """Video codec: encoder of FFmpeg, pixel format, file suffix, encoder options."""

    encoder: str
    pixels: str
    suffix: str
    options: dict[str, str] = field(default_factory=dict)


# Every second frame is a key frame, as in LeRobot: random access decodes at most two frames. No B-frames, so that
# packets are in frame order and videos join without edit lists. A fixed number of threads makes encoding deterministic.
VIDEO_CODECS = {
    "h264": VideoCodec(
        "libx264",
        "yuv420p",
        ".mp4",
        {"g": "2", "crf": "20", "preset": "veryfast", "bf": "0", "rc-lookahead": "0", "threads": "1"},
    ),
    "av1": VideoCodec("libsvtav1", "yuv420p", ".mp4", {"g": "2", "crf": "30", "preset": "10", "svtav1-params": "lp=1"}),
    # Lossless, 12 bits, codec of LeRobot depth. Slower presets take three times as long and halve the size.
    "depth12": VideoCodec(
        "libx265",
        "gray12le",
        ".mp4",
        {
            "g": "2",
            "preset": "ultrafast",
            "x265-params": "lossless=1:ctu=16:keyint=2:min-keyint=2:scenecut=0:bframes=0:open-gop=0:pools=none"
            ":frame-threads=1:log-level=none",
        },
    ),
    # Lossless, 16 bits, a checksum per slice, only key frames.
    "depth": VideoCodec("ffv1", "gray16le", ".mkv", {"level": "3", "slices": "4", "slicecrc": "1", "g": "1"}),
}
_MAX_PIXELS = 2**26  # per decoded frame: 8192 x 8192
_GREY = ("gray16le", "gray12le")
_BAD_VIDEO = (FFmpegError, OSError, DocumentError, IndexError, TypeError)  # the last two: no video stream, or no times
_CONTAINER = {"fflags": "+bitexact"}  # deterministic files
_FULL = {errno.ENOSPC, errno.EDQUOT, errno.EFBIG}


_LEVELS = 4096
DEPTH_INFO: Mapping[str, Any] = {
    "is_depth_map": True,
    "depth_unit": "mm",
    "video.depth_min": 0.0,
    "video.depth_max": MAX_DEPTH_MM / 1000,
    "video.shift": 0.0,
    "video.use_log": False,
    "video.g": 2,
    "video.preset": "ultrafast",
    "video.extra_options": {"x265-params": "lossless=1"},
}
"""Entries of a depth video in ``info.json``: range in m, and encoder options for the tools of LeRobot."""
_Metres = Annotated[float, Field(gt=-1e6, lt=1e6, allow_inf_nan=False)]


class _DepthRange(BaseModel):
    """Depth range of a video in m; defaults as in LeRobot."""

    model_config = ConfigDict(strict=True)

    depth_min: _Metres = Field(0.01, alias="video.depth_min")
    depth_max: _Metres = Field(10.0, alias="video.depth_max")
    shift: _Metres = Field(3.5, alias="video.shift")
    use_log: bool = Field(True, alias="video.use_log")

    @model_validator(mode="after")
    def _check_range(self) -> _DepthRange:
        if not self.depth_min < self.depth_max:
            raise ValueError(f"expected depth_min < depth_max, found {self.depth_min:g} and {self.depth_max:g}")
        if self.use_log and self.depth_min + self.shift <= 0:
            raise ValueError(f"expected depth_min + shift > 0, found {self.depth_min:g} and {self.shift:g}")
        return self


def find_codec(kind: ImageKind, codec: str, variant: Variant) -> VideoCodec:
    """Return the codec of RGB or depth videos; ``codec`` is the name of the RGB codec."""
    return VIDEO_CODECS[codec if kind == "rgb" else "depth12" if variant.native_depth else "depth"]


class VideoEncoder:
    """Encodes one video in a ``with`` statement; ``size`` is the width and height in pixels."""

    def __init__(self, path: Path, codec: VideoCodec, fps: int, size: tuple[int, int]) -> None:
        width, height = size
        if codec.pixels == "yuv420p":
            check_video_size(size)
        os.environ.setdefault("SVT_LOG", "1")  # log errors only
        self.frames, self._codec = 0, codec
        self._container = av.open(str(path), "w", options=_CONTAINER)
        try:
            stream: Any = self._container.add_stream(codec.encoder, rate=fps, options=codec.options)
        except (FFmpegError, ValueError) as error:
            self._container.close()
            raise DatasetError("this FFmpeg lacks the encoder", where=codec.encoder, found=error) from error
        stream.width, stream.height, stream.pix_fmt = width, height, codec.pixels
        self._stream, self._time_base = stream, Fraction(1, fps)

    def __enter__(self) -> VideoEncoder:
        return self

    def __exit__(self, kind: object, *_: object) -> None:
        try:
            if kind is None:
                self._container.mux(self._stream.encode(None))
            elif self._stream.codec_context.is_open:  # otherwise SVT-AV1 prints an error
                with suppress(FFmpegError):
                    self._stream.encode(None)
        finally:
            self._container.close()

    def add(self, image: NDArray) -> None:
        """Append a frame, (H, W, 3) uint8 RGB or (H, W) uint16."""
        layout = "rgb24" if image.ndim == 3 else self._codec.pixels
        frame = av.VideoFrame.from_ndarray(np.ascontiguousarray(image), format=layout)
        frame.pts, frame.time_base = self.frames, self._time_base
        self._container.mux(self._stream.encode(frame))
        self.frames += 1


class VideoJoiner:
    """Joins videos into larger files without encoding again; one output file is open at a time.

    ``path(chunk, number)`` returns the path of an output file.
    """

    def __init__(self, path: Callable[[int, int], Path], fps: int, limit_mb: float, limit_seconds: float) -> None:
        self._path, self._fps = path, fps
        self._limit_bytes, self._limit_frames = limit_mb * 2**20, limit_seconds * fps
        self._count = self._bytes = self._frames = 0  # number of files; size of the current file
        self._head: tuple[Any, ...] = ()
        self._out: Any = None
        self._stream: Any = None

    def add(self, path: Path, frames: int) -> tuple[int, int, int]:
        """Append a video with ``frames`` frames; return chunk, file, and index of its first frame in the file."""
        size = path.stat().st_size
        try:
            with av.open(str(path)) as video:
                stream = video.streams.video[0]
                head = (stream.codec_context.name, stream.width, stream.height, stream.codec_context.extradata)
                full = self._bytes + size > self._limit_bytes or self._frames + frames > self._limit_frames
                # After an interruption, an encoder of another version may write another header.
                if self._out is None or full or head != self._head:
                    self._start_file(stream, head)
                first, found = self._frames, 0
                for packet in video.demux(stream):
                    if packet.dts is None:  # end of the stream
                        continue
                    packet.pts = packet.dts = round(Fraction(first + found, self._fps) / packet.time_base)
                    packet.stream = self._stream
                    assert self._out is not None
                    self._out.mux(packet)
                    found += 1
        except FFmpegError as error:
            if error.errno in _FULL:  # of the output file
                raise
            raise DatasetError("damaged video", where=path, found=error.strerror) from error
        if found != frames:
            raise DatasetError("missing frames in this video", where=path, expected=frames, found=found)
        self._frames += frames
        self._bytes += size
        return *divmod(self._count - 1, CHUNK_FILES), first

    def close(self) -> None:
        if self._out is not None:
            self._out.close()
            self._out = None

    def _start_file(self, template: Any, head: tuple[Any, ...]) -> None:
        self.close()
        path = self._path(*divmod(self._count, CHUNK_FILES))
        path.parent.mkdir(parents=True, exist_ok=True)
        options = {**_CONTAINER, "movflags": "faststart"} if path.suffix == ".mp4" else _CONTAINER
        self._out = av.open(str(path), "w", options=options)
        self._stream = self._out.add_stream_from_template(template, opaque=True)  # keeps the codec parameters
        self._stream.time_base = template.time_base
        self._head, self._count = head, self._count + 1
        self._bytes = self._frames = 0


def read_frames(path: Path, first: int, count: int, fps: int) -> Generator[NDArray, None, None]:
    """Yield ``count`` frames from frame ``first`` on, (H, W, 3) uint8 RGB or (H, W) uint16.

    Close the generator to close the file.
    """
    given = 0
    try:
        check_regular_file(path)
        with av.open(str(path)) as video:
            stream: Any = video.streams.video[0]
            stream.codec_context.options = {"max_pixels": str(_MAX_PIXELS)}
            layout = pixels if (pixels := stream.codec_context.pix_fmt) in _GREY else "rgb24"
            video.seek(round(Fraction(first, fps) / stream.time_base), stream=stream, backward=True)
            for frame in video.decode(stream) if count > 0 else ():
                place = round(frame.pts * stream.time_base * fps)
                if place < first + given:
                    continue  # between the key frame and the first requested frame
                if place != first + given:
                    break
                yield frame.to_ndarray(format=layout)
                given += 1
                if given == count:
                    break
    except _BAD_VIDEO as error:
        raise DatasetError("the video can't be read", where=path, found=getattr(error, "strerror", error)) from error
    if given < count:
        raise DatasetError("missing frames in this video", where=path, expected=first + count, found=first + given)


def read_packet_times(path: Path, most: int | None = None) -> tuple[list[Fraction], dict[str, Any]]:
    """Read the frame times of a video in s, at most ``most`` + 1, and its description for ``info.json``."""
    try:
        check_regular_file(path)
        with av.open(str(path)) as video:
            stream: Any = video.streams.video[0]
            packets = (p.pts * p.time_base for p in video.demux(stream) if p.pts is not None)
            times = list(packets if most is None else islice(packets, most + 1))
            return sorted(times), _describe_stream(stream)
    except _BAD_VIDEO as error:
        raise DatasetError("the video can't be read", where=path, found=getattr(error, "strerror", error)) from error


def _describe_stream(stream: Any) -> dict[str, Any]:
    return {
        "video.height": stream.height,
        "video.width": stream.width,
        "video.codec": stream.codec.canonical_name,
        "video.pix_fmt": stream.pix_fmt,
        "video.fps": round(stream.average_rate or stream.base_rate),
        "video.channels": 1 if stream.pix_fmt in _GREY else 3,
        "has_audio": False,
    }


def to_levels(depth: NDArray[np.uint16]) -> NDArray[np.uint16]:
    """Convert depth (H, W) in mm to 12-bit levels; depth above 4095 mm becomes 4095."""
    return np.minimum(depth, np.uint16(MAX_DEPTH_MM))


def to_depth(levels: NDArray[np.uint16], info: Mapping[str, Any]) -> NDArray[np.uint16]:
    """Convert levels (H, W), 0 to 4095, to depth in mm; ``info`` of the video feature has the range."""
    values = parse(_DepthRange, dict(info), DatasetError, where="info", about="invalid range of a depth video")
    low, high, shift = values.depth_min, values.depth_max, values.shift
    fraction = levels.astype(np.float64) / (_LEVELS - 1)
    if values.use_log:
        first, last = np.log(low + shift), np.log(high + shift)
        metres = np.exp(first + fraction * (last - first)) - shift
    else:
        metres = low + fraction * (high - low)
    return np.clip(np.rint(metres * 1000), 0, 65535).astype(np.uint16)
