"""Videos of episodes that failed: they are played again, watched from over the robot's shoulder."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from itertools import zip_longest
from pathlib import Path
from typing import Any

import imageio.v2 as imageio
import torch

from robocas_ms3.core.errors import EvaluationError
from robocas_ms3.core.files import make_folder, replacing
from robocas_ms3.datasets.writing.render import require_renderer
from robocas_ms3.evaluation.outcomes import Outcome
from robocas_ms3.evaluation.policy import Policy
from robocas_ms3.evaluation.protocol import LoadedProtocol
from robocas_ms3.evaluation.report.failed import VIDEOS, video_name
from robocas_ms3.evaluation.results import Result
from robocas_ms3.evaluation.rollout import Rollouts, Rules
from robocas_ms3.evaluation.stage import make_env, object_ids, rate_of, start_of
from robocas_ms3.evaluation.weld import refuse

SIZE = (480, 360)  # pixels
_FRAMES = 5  # a second of the scene
_SPEED = 4  # times as fast as the scene


@dataclass(frozen=True)
class FailureVideo:
    """A video that was written; ``same``: what came of the episode is what had come of it before."""

    path: Path
    outcome: Outcome
    same: bool


def failed_of_each_kind(result: Result, count: int) -> list[int]:
    """Numbers of failed episodes: of each configuration in turn, and there of each failure stage in turn."""
    groups: dict[str, dict[str, list[int]]] = {}
    for outcome in result.outcomes.values():
        if not outcome.success:
            groups.setdefault(outcome.config, {}).setdefault(outcome.failure_stage, []).append(outcome.episode)
    return sorted(_in_turn([_in_turn(list(stages.values())) for stages in groups.values()])[:count])


def _in_turn(lists: list[list[int]]) -> list[int]:
    return [number for row in zip_longest(*lists) for number in row if number is not None]


def film(result: Result, protocol: LoadedProtocol, policy: Policy, episodes: Sequence[int]) -> Iterator[FailureVideo]:
    """Play episodes again, in processes, and write a video of each into the result's ``videos``.

    Raises:
        EvaluationError: the result is of another protocol.
        DatasetError: there is no render device.
    """
    if result.run["protocol_hash"] != protocol.hash:
        raise EvaluationError(
            "the result is of another protocol",
            where=result.folder,
            expected=result.run["protocol_hash"],
            found=protocol.hash,
        )
    protocol.rules.refuse(policy.spec)
    if result.run["weld"]:
        refuse(protocol.rules.stepping, "processes")
    require_renderer()
    make_folder(result.folder / VIDEOS)
    for config in dict.fromkeys(protocol.episodes[number].config for number in episodes):
        numbers = [number for number in episodes if protocol.episodes[number].config == config]
        yield from _film(result, protocol, policy, numbers)


def _film(result: Result, protocol: LoadedProtocol, policy: Policy, numbers: list[int]) -> Iterator[FailureVideo]:
    rules, first = protocol.rules, protocol.episodes[numbers[0]]
    rate = rate_of(protocol, policy.spec)
    size = {"width": SIZE[0], "height": SIZE[1]}
    watched = {"render_mode": "rgb_array", "human_render_camera_configs": size, "weld": result.run["weld"]}
    made = make_env(protocol, policy.spec, first, 1, backend="processes", **watched)
    env = _FilmedEnv(made, max(1, round(rate / _FRAMES)))
    try:
        for number in numbers:
            episode, before = protocol.episodes[number], result.outcomes[number]
            # as long as it was before, so that this is the same episode whatever ended it
            ends = Rules(before.steps, tuple(rules.ends_on), rules.max_v0_steps)
            path = result.folder / VIDEOS / video_name(number)
            with replacing(path) as tmp, _writer(tmp, rate / env.every * _SPEED) as writer:
                env.writer = writer
                (played,) = Rollouts(env, policy, ends, 1 / rate, refill=True).play([start_of(protocol, episode)])
            outcome = Outcome.of(played, episode, object_ids(protocol, episode))
            yield FailureVideo(path, outcome, outcome.without_clock() == before.without_clock())
    finally:
        env.close()


@dataclass
class _FilmedEnv:
    """An environment that adds pictures to a video.

    Attributes:
        env: one env, as NumPy arrays.
        every: how many policy steps a picture.
        writer: of the video.
    """

    env: Any
    every: int
    writer: Any = None
    num_envs: int = 1
    _steps: int = field(default=0, init=False)

    def reset(self, **kwargs: Any) -> Any:
        """Reset, and look."""
        self._steps = 0
        result = self.env.reset(**kwargs)
        self._look()
        return result

    def step(self, actions: Any) -> Any:
        """One policy step, and a look every few."""
        result = self.env.step(actions)
        self._steps += 1
        if self._steps % self.every == 0:
            self._look()
        return result

    def close(self) -> None:
        """End its process."""
        self.env.close()

    def _look(self) -> None:
        self.writer.append_data(torch.as_tensor(self.env.render())[0].cpu().numpy())


def _writer(path: Path, fps: float) -> Any:
    return imageio.get_writer(
        path,
        fps=fps,
        codec="libx264",
        pixelformat="yuv420p",
        quality=6,
        macro_block_size=2,
        ffmpeg_log_level="error",
    )
