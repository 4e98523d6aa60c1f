"""Whether a dataset holds what a baseline sees, hears and keeps time by: seen before anything is decoded."""

from __future__ import annotations

from collections.abc import Sequence

from robocas_ms3.core.errors import DatasetError
from robocas_ms3.datasets.sources.protocol import EpisodeSource


def check_fits(
    source: EpisodeSource,
    baseline: str,
    cameras: Sequence[str],
    rate_hz: float,
    *,
    language: bool = True,
    other_cameras: str,
    without_language: str = "",
) -> None:
    """Check a dataset.

    Args:
        source: it.
        baseline: name of what is to learn from it.
        cameras: that it looks through.
        rate_hz: steps a second that it acts at.
        language: whether it is told what to do.
        other_cameras: option by which it would look through others, for messages.
        without_language: option by which it would do without; empty: there is none.

    Raises:
        DatasetError: the dataset lacks a camera or embeddings, or is of another rate.
    """
    if any(camera not in source.cameras for camera in cameras):
        raise DatasetError(
            f"no pictures of a camera of {baseline}",
            where=source.root,
            expected=", ".join(cameras),
            found=", ".join(source.cameras) or "none",
            fix=f"Convert the trajectory with these cameras, or train with {other_cameras}.",
        )
    if language and not source.has_embeddings:
        more = f", or train with {without_language}" * bool(without_language)
        raise DatasetError(
            f"{baseline} needs embeddings of the instructions",
            where=source.root,
            found="none",
            fix=f"Convert the trajectory with embeddings{more}; a LeRobot folder has none.",
        )
    if source.rate_hz != rate_hz:
        raise DatasetError(
            f"steps at another rate than {baseline} is to act at",
            where=source.root,
            expected=f"{rate_hz:g} Hz",
            found=f"{source.rate_hz:g} Hz",
            fix=f"Convert with --rate {rate_hz:g}, or train with --set rate_hz={source.rate_hz:g}.",
        )
