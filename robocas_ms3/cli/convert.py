"""``robocas convert``: convert recorded episodes or a dataset to a dataset."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import fields
from typing import TYPE_CHECKING

from robocas_ms3.cli.options import resumable
from robocas_ms3.core.errors import DatasetError
from robocas_ms3.core.text import format_count
from robocas_ms3.datasets.conversion.settings import ConversionResult, ConversionSettings

if TYPE_CHECKING:
    from robocas_ms3.datasets.formats import Format


@resumable
def main(settings: ConversionSettings) -> int:
    from robocas_ms3.cli.progress import ProgressBar, format_duration
    from robocas_ms3.cli.terminal import print_line

    write: Callable[..., ConversionResult] = _find_format(settings).import_function("writer")
    with ProgressBar("episodes written") as bar:
        done = write(settings, on_start=bar.start, on_episode=bar.advance)
    count = len(done.episodes)
    words = [f"{settings.out}: {format_count(count, 'episode')}"]
    words += [f"{done.existing} already there"] if done.existing else []
    if count:
        megabytes = sum(episode.size for episode in done.episodes) / 1e6
        steps = format_count(sum(episode.steps for episode in done.episodes), "step")
        words += [steps, f"{megabytes:.0f} MB", format_duration(done.seconds)]
    print_line(", ".join(words))
    if count and settings.video and settings.to == "robocas" and not done.previews:
        print_line(
            "no videos were written, because there are more than 20 episodes: pass --all-videos, or run robocas video"
        )
    return 0


def _find_format(settings: ConversionSettings) -> Format:
    """Return the format of --to; raise DatasetError if it is unknown, or if an option does not apply to it."""
    from robocas_ms3.core.text import did_you_mean
    from robocas_ms3.datasets.formats import FORMATS

    writable = [name for name, known in FORMATS.items() if known.writer]
    if settings.to not in writable:
        expected, fix = f"one of {', '.join(writable)}", did_you_mean(settings.to, writable)
        raise DatasetError("unknown dataset format", where="--to", expected=expected, found=settings.to, fix=fix)
    chosen = FORMATS[settings.to]
    of_others = {option for known in FORMATS.values() for option in known.options if option not in chosen.options}
    for field in fields(settings):
        if field.name in of_others and getattr(settings, field.name) != field.default:
            flag = f"--{field.name.replace('_', '-')}"
            raise DatasetError(f"this option does not apply to a {chosen.title}", where=flag, fix="Omit the option.")
    return chosen
