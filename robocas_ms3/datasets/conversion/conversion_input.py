"""Input of a conversion: a trajectory file to render, or a dataset of any format with images."""

from __future__ import annotations

import logging
from collections.abc import Generator, Mapping
from contextlib import closing
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from robocas_ms3.core.documents import DAMAGED_FILE_ERRORS
from robocas_ms3.core.errors import DatasetError
from robocas_ms3.core.text import format_count, one_line
from robocas_ms3.datasets import schema
from robocas_ms3.datasets.conversion.rendered_source import RenderedSource, open_env_renderer
from robocas_ms3.datasets.conversion.settings import ConversionSettings
from robocas_ms3.datasets.formats import open_source
from robocas_ms3.datasets.images.image_files import ImageOptions
from robocas_ms3.datasets.sources.arrays import fingerprint_arrays
from robocas_ms3.datasets.sources.episode_source import EpisodeSource, SourceEpisode, StepImages
from robocas_ms3.datasets.sources.files import SEE_VALIDATE

REQUIRED_ARRAYS = frozenset(spec.name for spec in schema.EPISODE_INFO if not (spec.embedding or spec.optional)) - {
    *schema.RELATIVE_PAIRS[1][2:]  # derived from the base poses
}
"""Arrays that an episode must have to be converted."""
_log = logging.getLogger(__name__)


@dataclass(frozen=True)
class ConversionInput:
    """Open input of a conversion: the episodes to convert and the images to write.

    Attributes:
        source: source of the episodes.
        image_options: the requested images, as far as the source has them.
        include_failed: whether failed episodes are converted.
        sizes: width and height of the stored images by camera; empty if images are rendered.
    """

    source: EpisodeSource
    image_options: ImageOptions
    include_failed: bool = False
    sizes: Mapping[str, tuple[int, int]] = field(default_factory=dict)

    def entries(self) -> list[dict[str, Any]]:
        """Return one entry per episode to convert, as in ``conversion.json``.

        ``source`` in an entry is the number of the episode in the input. Duplicate recordings of a trajectory file have
        one entry.
        """
        entries = ((number, self._make_entry(number)) for number in self.source.numbers)
        chosen = [{"source": number, **entry} for number, entry in entries if entry is not None]
        if not chosen:
            has_episodes = bool(self.source.numbers)
            raise DatasetError(
                "no successful episodes to convert" if has_episodes else "no episodes to convert",
                where=self.source.root,
                found=format_count(len(self.source.numbers), "episode"),
                fix="Pass --include-failed to convert failed episodes." if has_episodes else "",
            )
        if isinstance(self.source, RenderedSource):
            _warn_unchecked_rate(self.source, chosen)
            return _drop_duplicates(self.source, chosen)
        return chosen

    def _make_entry(self, number: int) -> dict[str, Any] | None:
        """Make the entry of an episode for ``conversion.json``; None if the episode is not converted."""
        known = self.source.conversion_entry(number)
        if isinstance(self.source, RenderedSource):
            return dict(known) if self.include_failed or known["success"] else None
        episode = self.source.episode(number)
        scene = episode.scene
        success = scene.get("success", known.get("success"))
        if success is False and not self.include_failed:
            return None
        recording = (scene.get("source") or {}).get("recording") or known.get("recording")
        return {
            "trajectory": known.get("trajectory"),
            "trajectory_episode": known.get("trajectory_episode"),
            "seed": scene.get("seed", known.get("seed")),
            "success": success,
            "target": scene.get("target", known.get("target")),
            "recording": recording or f"arrays {fingerprint_arrays(require_complete_arrays(episode))}",
        }

    def frames(self, episode: SourceEpisode) -> Generator[StepImages, None, None]:
        """Yield the images of each step of an episode; close the generator if you stop before the last step."""
        with closing(episode.images(self.image_options)) as frames:
            for step, frame in enumerate(frames):
                for kind, images in (("rgb", frame.rgb), ("depth", frame.depth)) if self.sizes else ():
                    for camera, image in images.items():
                        expected, found = (f"{w} x {h}" for w, h in (self.sizes[camera], _image_size(image)))
                        if found != expected:
                            what, where = (
                                "this image has another size than the dataset",
                                f"{episode.where}, {camera}/{kind}, step {step}",
                            )
                            raise DatasetError(what, where=where, expected=expected, found=found, fix=SEE_VALIDATE)
                yield frame

    def close(self) -> None:
        self.source.close()


def open_input(settings: ConversionSettings) -> ConversionInput:
    """Open the trajectory file or the dataset that a conversion reads.

    Raises:
        DatasetError: a requested camera is unknown, or stored images do not have the requested size.
    """
    if settings.is_trajectory:
        rendered = open_trajectory(settings)
        return ConversionInput(rendered, rendered.image_options, settings.include_failed)
    source, wanted = open_source(settings.source, rate_hz=settings.rate_hz), settings.image_options
    first = source.episode(source.numbers[0])
    image_options = wanted.select_cameras(first.cameras, source.root)
    sizes = {camera: _image_size(first.rgb(camera, 0)) for camera in image_options.cameras}
    different = sorted(set(sizes.values()))
    size = different[0] if len(different) == 1 else None
    if wanted.size not in (None, size):
        what, fix = "the images of a dataset can't be resized", "Convert the trajectory file with this --size."
        expected = ", ".join(f"{width} x {height}" for width, height in different)
        raise DatasetError(what, where=source.root, expected=expected, found=list(wanted.size or ()), fix=fix)
    image_options = replace(image_options, size=size, depth=wanted.depth and source.has_depth)
    return ConversionInput(source, image_options, settings.include_failed, sizes)


def open_trajectory(settings: ConversionSettings) -> RenderedSource:
    """Open a trajectory file as a source that renders the images of its episodes."""
    return RenderedSource(
        settings.source,
        rate_hz=settings.rate_hz,
        image_options=settings.image_options,
        pack=settings.pack,
        open_renderer=settings.open_renderer or open_env_renderer,
    )


def require_complete_arrays(episode: SourceEpisode) -> dict[str, NDArray]:
    """Return the arrays of an episode; raise DatasetError if required arrays are missing or damaged."""
    try:
        arrays = episode.arrays
    except DAMAGED_FILE_ERRORS as error:
        what, found = "the arrays can't be read", one_line(error)
        raise DatasetError(what, where=episode.where, found=found, fix=SEE_VALIDATE) from error
    missing, lengths = sorted(REQUIRED_ARRAYS - set(arrays)), set()
    for key in sorted(REQUIRED_ARRAYS & set(arrays)):
        if arrays[key].dtype.kind == "f" and not np.isfinite(arrays[key]).all():
            where = f"{episode.where}/{schema.EPISODE_FILE}, {key}"
            raise DatasetError("NaN or infinite value in this array", where=where, fix=SEE_VALIDATE)
        lengths |= {len(arrays[key])} if arrays[key].ndim else set()
    if missing or lengths != {episode.steps}:
        expected = ", ".join(missing) if missing else f"arrays with {format_count(episode.steps, 'row')}"
        found = "no such arrays" if missing else f"arrays with {sorted(lengths)} rows"
        what = "this episode is incomplete"
        raise DatasetError(what, where=episode.where, expected=expected, found=found, fix=SEE_VALIDATE)
    return arrays


def _image_size(image: NDArray) -> tuple[int, int]:
    return image.shape[1], image.shape[0]


def _drop_duplicates(source: EpisodeSource, entries: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """Drop entries whose recording has an earlier entry; entries of unreadable recordings are kept."""
    first = {entry["recording"]: entry for entry in reversed(entries)}
    distinct = [entry for entry in entries if entry["recording"] is None or first[entry["recording"]] is entry]
    if len(distinct) < len(entries):
        duplicates = [str(entry["trajectory_episode"]) for entry in entries if entry not in distinct]
        _log.warning("%s: skipped duplicate recordings: episodes %s", source.root, ", ".join(duplicates))
    return distinct


def _warn_unchecked_rate(source: RenderedSource, entries: list[dict[str, Any]]) -> None:
    recorded = [source.file.episodes[entry["source"]].get("robocas") for entry in entries]
    checked = [one.get("check_rate") for one in recorded if isinstance(one, dict)]
    rates = {float(rate) for rate in checked if isinstance(rate, int | float) and rate}
    others = sorted(rate for rate in rates if abs(rate - source.rate_hz) > 1e-9)
    if others:
        _log.warning(
            "the recorded actions were checked open loop at %s Hz, but the dataset has %g Hz; check it with"
            " robocas validate --replay",
            *(" and ".join(f"{rate:g}" for rate in others), source.rate_hz),
        )
