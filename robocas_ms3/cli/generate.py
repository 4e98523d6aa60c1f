"""``robocas generate``: record demonstrations with a scripted policy."""

from __future__ import annotations

from functools import partial
from typing import TYPE_CHECKING

from robocas_ms3.cli.options import resumable
from robocas_ms3.core.text import format_count
from robocas_ms3.demos.settings import GenerateSettings

if TYPE_CHECKING:
    from robocas_ms3.demos.failures import EpisodeResult


@resumable
def main(settings: GenerateSettings) -> int:
    settings = settings.resolve()  # reports an invalid configuration before the slow imports
    from robocas_ms3.cli.progress import ProgressBar
    from robocas_ms3.cli.terminal import print_line
    from robocas_ms3.demos.generation import generate

    make_roll_in, weights = None, ""
    if settings.episode.after_policy:
        from robocas_ms3.evaluation.rollouts.policy_rollin import PolicyRollIn, check_roll_in_policy

        weights = check_roll_in_policy(settings.episode)
        make_roll_in = partial(PolicyRollIn, settings.episode)
    with ProgressBar("episodes recorded") as bar:

        def on_result(result: EpisodeResult) -> None:
            if result.success:
                bar.advance()
            else:
                last = result.failures[-1]
                bar.add_note(f"seed {result.seed} is skipped ({last.stage}: {last.reason})")

        def on_start(present: int) -> None:
            if present >= settings.episodes:
                bar.add_note(f"{settings.out} already has {format_count(present, 'episode')} (-n {settings.episodes})")
            bar.start(settings.episodes, min(present, settings.episodes))

        summary = generate(settings, on_start=on_start, on_result=on_result, make_roll_in=make_roll_in, weights=weights)
        bar.update(settings.episodes, settings.episodes)  # episodes of a continued run may count only now
    seconds = ", ".join(f"{part} {value:.2f}" for part, value in summary.mean_seconds.items())
    episodes, seeds = format_count(summary.episodes, "episode"), format_count(summary.seeds, "seed")
    print_line(f"{episodes} from {seeds} (success rate {summary.success_rate:.0%})")
    print_line(f"mean seconds per seed: {seconds}; mean length: {summary.mean_steps:.0f} steps")
    if summary.failures:
        print_line("failed attempts: " + ", ".join(f"{reason} x{n}" for reason, n in summary.failures.items()))
    print_line(f"wrote {summary.trajectory}{' and candidates.h5' if settings.episode.record_candidates else ''}")
    return 0
