"""``robocas replay``: replay recorded episodes."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro

from robocas_ms3.cli.options import Maybe
from robocas_ms3.core.words import count_of


@dataclass
class Replay:
    """Replay a trajectory file: its actions, its states, or its actions in another control mode.

    Exit code 1 if an episode does not succeed.

    Example: robocas replay demos/pick --count 2
    """

    trajectory: Annotated[Path, tyro.conf.Positional]
    """F.h5, with F.json next to it, or the output folder of `robocas generate`."""
    control_mode: Annotated[Maybe[str], tyro.conf.arg(aliases=["-c"])] = None
    """Convert the actions: pd_joint_delta_pos, pd_ee_delta_pose or pd_ee_pose. Default: as recorded."""
    obs_mode: Annotated[str, tyro.conf.arg(aliases=["-o"])] = "none"
    """Observations to record with --save, e.g. rgb+depth or state."""
    use_env_states: bool = False
    """Set the recorded state after every step."""
    count: Maybe[int] = None
    """Only the first so many episodes, at least 1."""
    save: Maybe[Path] = None
    """Write the replayed episodes to this HDF5 file."""
    allow_failure: bool = False
    """With --save: write failed episodes too."""
    pack: Maybe[str] = None
    """Object pack to use instead of the recorded one: its name, or its folder."""
    overwrite: bool = False
    """Replace the file given by --save if it exists."""


def main(cfg: Replay) -> int:
    """Run the command."""
    import numpy as np

    from robocas_ms3.cli.bars import bar
    from robocas_ms3.cli.terminal import say
    from robocas_ms3.demos.recordings.entries import read_json

    trajectory = cfg.trajectory / "trajectory.h5" if cfg.trajectory.is_dir() else cfg.trajectory
    total = len(read_json(trajectory)["episodes"][: cfg.count])
    from robocas_ms3.core.workers import use_one_torch_thread
    from robocas_ms3.demos.replay import replay  # takes seconds to import

    use_one_torch_thread()
    replayed = replay(
        trajectory,
        control_mode=cfg.control_mode,
        obs_mode=cfg.obs_mode,
        use_env_states=cfg.use_env_states,
        count=cfg.count,
        save=cfg.save,
        allow_failure=cfg.allow_failure,
        overwrite=cfg.overwrite,
        pack=cfg.pack,
    )
    done = []
    with bar("episodes replayed") as shown:
        for result in replayed:
            done.append(result)
            shown.next_of(total)
    for result in done:
        if not result.success:
            say(f"episode {result.episode_id} (seed {result.seed}): not successful")
    good = sum(result.success for result in done)
    say(f"{good} of {count_of(len(done), 'episode')} succeeded")
    errors = [result.state_error for result in done if result.state_error is not None]
    if errors:
        say(f"greatest difference from a recorded final state: {np.max(errors):.3g}")  # NaN where one is
    return 0 if good == len(done) else 1
