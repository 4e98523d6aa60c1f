"""``robocas render-candidates``: render the images of the decisions in a candidates file."""

from __future__ import annotations

from robocas_ms3.cli.options import resumable
from robocas_ms3.core.text import format_count
from robocas_ms3.datasets.candidate_images.settings import CandidateImageSettings


@resumable
def main(settings: CandidateImageSettings) -> int:
    from robocas_ms3.cli.progress import ProgressBar
    from robocas_ms3.cli.terminal import print_line
    from robocas_ms3.datasets.candidate_images.render import render_candidates

    with ProgressBar("decisions rendered") as bar:
        done = render_candidates(settings, on_decisions=bar.update)
    words = [f"{settings.output}: {format_count(done.decisions, 'decision')}", f"{done.size / 1e6:.1f} MB"]
    if done.rendered < done.decisions:
        words.append(f"{done.decisions - done.rendered} already there")
    if done.rendered:
        words.append(f"{done.rendered} rendered in {done.seconds:.1f} s")
    print_line(", ".join(words))
    return 0
