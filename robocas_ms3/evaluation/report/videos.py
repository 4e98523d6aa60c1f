"""Videos of episodes, which run again with a camera behind the robot."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import closing
from itertools import zip_longest
from pathlib import Path
from typing import Any, Literal

import torch

from robocas_ms3.core.errors import EvaluationError
from robocas_ms3.core.files import atomic_file, make_folder
from robocas_ms3.datasets.conversion.env_renderer import require_renderer
from robocas_ms3.datasets.images.video import open_video
from robocas_ms3.evaluation.policy import Policy
from robocas_ms3.evaluation.protocols.protocol import LoadedProtocol
from robocas_ms3.evaluation.report.page import VIDEOS, video_file_name
from robocas_ms3.evaluation.results.result_files import Result
from robocas_ms3.evaluation.rollouts.session import EvaluationSession
from robocas_ms3.evaluation.settings import EvaluationSettings

SIZE = (480, 360)  # pixels
_FRAMES = 5  # per simulated second
_SPEED = 4  # playback speed relative to simulated time


def choose_episodes(
    result: Result, count: int, outcomes: Literal["failed", "succeeded", "all"] = "failed"
) -> list[int]:
    """Return the numbers of at most ``count`` episodes, chosen in turn per configuration and failure stage."""
    groups: dict[str, dict[str, list[int]]] = {}
    for outcome in result.outcomes.values():
        if outcomes in ("all", "succeeded" if outcome.success else "failed"):
            groups.setdefault(outcome.config, {}).setdefault(outcome.failure_stage, []).append(outcome.episode)
    return sorted(_interleave([_interleave(list(stages.values())) for stages in groups.values()])[:count])


def _interleave(lists: list[list[int]]) -> list[int]:
    return [number for row in zip_longest(*lists) for number in row if number is not None]


def record_videos(
    result: Result, protocol: LoadedProtocol, policy: Policy, episodes: Sequence[int], folder: Path | None = None
) -> Iterator[tuple[Path, bool]]:
    """Run episodes of a result again in worker processes and write a video of each into a folder.

    The default folder is ``videos`` in the folder of the result. Yields the path of each video, and whether the outcome
    of the episode equals the recorded outcome.
    """
    if (expected := result.run.protocol_hash) != (found := protocol.hash):
        raise EvaluationError(
            "the result was measured with other files of the protocol",
            where=result.folder,
            expected=f"protocol hash {expected}",
            found=found,
        )
    require_renderer()
    recorder = _VideoRecorder()
    outcomes = result.outcomes.values()
    splits = {one.split for one in outcomes}
    settings = EvaluationSettings(  # only the tasks and splits of the result, for the warnings of the policy
        tuple(dict.fromkeys(one.task for one in outcomes)),
        split=splits.pop() if len(splits) == 1 else "",
        protocol=str(protocol.folder),
        envs=1,
        backend="processes",
        weld=result.run.weld,
        action_noise=result.run.action_noise or (0.0, 0.0),
        render_size=SIZE,
    )
    session = EvaluationSession(policy, settings, recorder.wrap)
    recorder.period = max(1, round(session.rate / _FRAMES))
    folder = folder or result.folder / VIDEOS
    make_folder(folder)
    with closing(session):
        for number in sorted(episodes, key=lambda one: protocol.episodes[one].config):
            before, path = result.outcomes[number], folder / video_file_name(number)
            # As many steps as recorded, whatever ended the episode.
            fps = session.rate / recorder.period * _SPEED
            with atomic_file(path) as tmp, open_video(tmp, fps, quality=6) as recorder.writer:
                (evaluated,) = session.run_episodes([protocol.episodes[number]], before.steps)
            yield path, evaluated.outcome.reproducible_values() == before.reproducible_values()


class _VideoRecorder:
    """Wrapper of a vector environment with one env that adds an image to a video every ``period`` policy steps."""

    num_envs = 1

    def __init__(self) -> None:
        self._env: Any = None
        self._steps = 0
        self.writer: Any = None
        self.period = 1

    def wrap(self, env: Any) -> _VideoRecorder:
        self._env = env
        return self

    def reset(self, **kwargs: Any) -> Any:
        self._steps = 0
        result = self._env.reset(**kwargs)
        self._add_image()
        return result

    def step(self, actions: Any) -> Any:
        result = self._env.step(actions)
        self._steps += 1
        if self._steps % self.period == 0:
            self._add_image()
        return result

    def render_images(self, envs: Any) -> Any:
        return self._env.render_images(envs)

    def camera_models(self) -> Any:
        return self._env.camera_models()

    def close(self) -> None:
        self._env.close()

    def _add_image(self) -> None:
        self.writer.append_data(torch.as_tensor(self._env.render())[0].cpu().numpy())
