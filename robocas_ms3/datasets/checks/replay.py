"""Replay the actions of each episode open loop in its rebuilt scene."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from contextlib import closing
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from robocas_ms3.core.errors import RobocasError
from robocas_ms3.core.text import one_line
from robocas_ms3.datasets.actions import compute_actions
from robocas_ms3.datasets.sources.file_models import EnvInfoRecord, LayoutRecord, SceneRecord, read_scene
from robocas_ms3.datasets.sources.reader import Dataset
from robocas_ms3.demos.open_loop import OpenLoopEnv
from robocas_ms3.demos.recordings.environment import read_recorded_env
from robocas_ms3.demos.recordings.trajectory_json import parse_seed, read_reset_options

_SAME_PLACE = 1e-3  # m
_BASE_STILL = 1e-3  # m; 7-D actions do not move the base


@dataclass(frozen=True)
class EpisodeReplay:
    """Outcome of the replay of an episode.

    Attributes:
        number: number of the episode.
        task: name of the task; empty if unknown.
        success: whether the replay succeeded; None: the episode was not replayed.
        mean_error: mean distance between replayed and recorded TCP, m.
        max_error: largest distance between replayed and recorded TCP, m.
        clipped: number of actions beyond the limits of the controller.
        skipped: why the episode was not replayed; empty if it was.
    """

    number: int
    task: str
    success: bool | None
    mean_error: float = 0.0
    max_error: float = 0.0
    clipped: int = 0
    skipped: str = ""


@dataclass(frozen=True)
class ReplayReport:
    """Result of the open-loop replay of a dataset: one outcome per episode."""

    episodes: list[EpisodeReplay] = field(default_factory=list)

    def summarize_by_task(self) -> dict[str, dict[str, Any]]:
        """Return counts of replays and successes, success rate, and tracking errors in m, by task name."""
        result = {}
        for task in sorted({episode.task for episode in self.episodes}):
            of_task = [episode for episode in self.episodes if episode.task == task]
            replayed = [episode for episode in of_task if episode.success is not None]
            succeeded = sum(bool(episode.success) for episode in replayed)
            result[task] = {
                "replayed": len(replayed),
                "succeeded": succeeded,
                "success_rate": succeeded / len(replayed) if replayed else None,
                "mean_error": float(np.mean([episode.mean_error for episode in replayed])) if replayed else None,
                "max_error": max((episode.max_error for episode in replayed), default=None),
                "skipped": len(of_task) - len(replayed),
            }
        return result

    def as_json(self) -> dict[str, Any]:
        return {"by_task": self.summarize_by_task(), "episodes": [asdict(episode) for episode in self.episodes]}


def replay_dataset(
    root: str | Path,
    *,
    pack: str | Path | None = None,
    on_episode: Callable[[int, int], None] = lambda done, count: None,
) -> ReplayReport:
    """Replay the 7-D actions of each episode of a RoboCAS folder open loop with ``pd_ee_delta_pose``.

    ``pack`` is the name or folder of an object pack that replaces the recorded one.

    Raises:
        DatasetError: there is no dataset, or actions can't be replayed at its rate.
    """
    dataset, replays = Dataset(Path(root)), []
    with closing(_Replayer(dataset.rate_hz, pack)) as replayer:
        for number in dataset.numbers:
            episode = dataset.episode(number)
            task = ""
            try:
                scene = read_scene(episode.scene, episode.where)
                task = scene.task or ""
                replays.append(replayer.replay(number, task, scene, episode.arrays))
            except (RobocasError, ValueError, TypeError, KeyError, IndexError, AttributeError, OSError) as error:
                replays.append(EpisodeReplay(number, task, None, skipped=one_line(error)))
            on_episode(len(replays), len(dataset.numbers))
    return ReplayReport(replays)


class _Replayer:
    """Replays episodes; makes a new environment only if an episode has other environment arguments."""

    def __init__(self, rate_hz: float, pack: str | Path | None) -> None:
        self._rate_hz, self._pack = rate_hz, pack
        self._env_info: EnvInfoRecord | None = None
        self._open_loop: OpenLoopEnv | None = None

    def replay(self, number: int, task: str, scene: SceneRecord, arrays: Mapping[str, NDArray]) -> EpisodeReplay:
        seed, reason = parse_seed(scene.seed), _find_skip_reason(scene, arrays)
        if seed is None or reason:
            return EpisodeReplay(number, task, None, skipped=reason)
        if self._open_loop is None or scene.env_info != self._env_info:
            self.close()
            env = read_recorded_env(
                scene.env_info and scene.env_info.model_dump(), "scene.json, env_info", pack=self._pack
            )
            self._env_info, self._open_loop = scene.env_info, OpenLoopEnv(env, self._rate_hz)
        self._open_loop.reset(seed, read_reset_options(scene.reset_options, "reset_options"))
        difference = _describe_scene_difference(scene.layout or LayoutRecord(), self._open_loop)
        if difference:
            return EpisodeReplay(number, task, None, skipped=f"the seed builds another scene: {difference}")
        outcome = self._open_loop.replay(compute_actions(arrays)[:-1])
        error = np.linalg.norm(outcome.tcp_in_base - arrays["ee_pos"], axis=1)
        return EpisodeReplay(number, task, outcome.success, float(error.mean()), float(error.max()), outcome.clipped)

    def close(self) -> None:
        if self._open_loop is not None:
            self._open_loop.close()
            self._open_loop = None


def _describe_scene_difference(recorded: LayoutRecord, open_loop: OpenLoopEnv) -> str:
    built = open_loop.layout
    if recorded.object_ids and recorded.object_ids != list(built.object_ids):
        return "other objects"
    for name, recorded_poses, poses in (
        ("objects", recorded.poses, built.object_poses),
        ("the robot", recorded.robot_pose, built.robot_pose),
        ("the basket", recorded.basket_pose, built.basket_pose),
    ):
        if recorded_poses and poses is not None:
            differences = np.reshape(recorded_poses, (-1, 7))[:, :3] - np.reshape(poses, (-1, 4, 4))[:, :3, 3]
            distance = np.linalg.norm(differences, axis=1).max()
            if distance > _SAME_PLACE:
                return f"{name} displaced by up to {distance * 1000:.0f} mm"
    return ""


def _find_skip_reason(scene: SceneRecord, arrays: Mapping[str, NDArray]) -> str:
    if not scene.env_info or parse_seed(scene.seed) is None:
        return "scene.json lacks env_info or seed, so the scene can't be built"
    if scene.success is False:
        return "the recording did not succeed"
    if scene.recorded and scene.recorded.intervention is not None:
        return "the episode starts where another policy stopped (expert intervention), so its seed can't reproduce it"
    if scene.recorded and scene.recorded.action_noise is not None:
        return "the actions are the intended actions of a demonstration with action noise, not the executed ones"
    if len(arrays["ee_pos"]) < 2:
        return "the episode has no actions"
    if not all(np.isfinite(arrays[key]).all() for key in ("rel_pos", "rel_orn", "ee_pos", "base_pos")):
        return "NaN or infinite values in the arrays"
    base = arrays["base_pos"]
    if np.linalg.norm(base - base[0], axis=1).max() > _BASE_STILL:
        return "the base moves, which 7-D actions can't express"
    return ""
