"""``robocas replay``: replay recorded episodes."""

from __future__ import annotations

from robocas_ms3.core.text import format_count
from robocas_ms3.demos.settings import ReplaySettings


def main(settings: ReplaySettings) -> int:
    import numpy as np

    from robocas_ms3.cli.progress import ProgressBar
    from robocas_ms3.cli.terminal import print_line
    from robocas_ms3.demos.recordings.trajectory_json import read_json

    total = len(
        read_json(settings.file)["episodes"][: settings.count]
    )  # reports a damaged file before the slow imports
    from robocas_ms3.core.workers import use_one_torch_thread
    from robocas_ms3.demos.trajectory_replay import replay

    use_one_torch_thread()
    results = replay(settings)
    done = []
    with ProgressBar("episodes replayed") as bar:
        for result in results:
            done.append(result)
            bar.update(len(done), total)
    for result in done:
        if not result.success:
            print_line(f"episode {result.episode_id} (seed {result.seed}) failed")
    successes = sum(result.success for result in done)
    print_line(f"{successes} of {format_count(len(done), 'episode')} succeeded")
    errors = [result.state_error for result in done if result.state_error is not None]
    if errors:
        print_line(
            f"largest deviation of a final state from the recording: {np.max(errors):.3g}"
        )  # NaN if an error is NaN
    return 0 if successes == len(done) else 1
