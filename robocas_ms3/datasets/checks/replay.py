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
from robocas_ms3.datasets.actions import episode_actions
from robocas_ms3.datasets.sources.file_models import EnvInfo, Layout, SceneRecord, read_scene
from robocas_ms3.datasets.sources.reader import Dataset
from robocas_ms3.demos.open_loop import OpenLoopEnv
from robocas_ms3.demos.recordings.environment import read_env
from robocas_ms3.demos.recordings.trajectory_json import one_seed, read_reset_options

_SAME_PLACE = 1e-3  # m
_BASE_STILL = 1e-3  # m that the base may move in all: 7-D actions do not move it


@dataclass(frozen=True)
class EpisodeReplay:
    """Outcome of one episode; without ``success`` it was not replayed.

    Errors are distances of the TCP from the recorded one, m; ``clipped`` actions exceed the limits of the controller.
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
    """Outcomes of a dataset."""

    episodes: list[EpisodeReplay] = field(default_factory=list)

    def by_task(self) -> dict[str, dict[str, Any]]:
        """Return counts, success rate and tracking errors in m of each task."""
        result = {}
        for task in sorted({episode.task for episode in self.episodes}):
            of_task = [episode for episode in self.episodes if episode.task == task]
            tried = [episode for episode in of_task if episode.success is not None]
            succeeded = sum(bool(episode.success) for episode in tried)
            result[task] = {
                "tried": len(tried),
                "succeeded": succeeded,
                "share": succeeded / len(tried) if tried else None,
                "mean_error": float(np.mean([episode.mean_error for episode in tried])) if tried else None,
                "max_error": max((episode.max_error for episode in tried), default=None),
                "skipped": len(of_task) - len(tried),
            }
        return result

    def as_json(self) -> dict[str, Any]:
        return {"by_task": self.by_task(), "episodes": [asdict(episode) for episode in self.episodes]}


def replay_dataset(
    root: str | Path,
    *,
    pack: str | Path | None = None,
    on_episode: Callable[[int, int], None] = lambda done, count: None,
) -> ReplayReport:
    """Replay the 7-D actions of a RoboCAS folder with ``pd_ee_delta_pose``; ``pack``: instead of the recorded one.

    Raises:
        DatasetError: there is no dataset, or actions can't be replayed at its rate.
    """
    dataset, replays = Dataset(Path(root)), []
    with closing(_Player(dataset.rate_hz, pack)) as player:
        for number in dataset.numbers:
            episode = dataset.episode(number)
            task = ""
            try:
                scene = read_scene(episode.scene, episode.where)
                task = scene.task or ""
                replays.append(player.play(number, task, scene, episode.arrays))
            except (RobocasError, ValueError, TypeError, KeyError, IndexError, AttributeError, OSError) as error:
                replays.append(EpisodeReplay(number, task, None, skipped=one_line(error)))
            on_episode(len(replays), len(dataset.numbers))
    return ReplayReport(replays)


class _Player:
    """Keeps the environment as long as it is the same."""

    def __init__(self, rate_hz: float, pack: str | Path | None) -> None:
        self._rate_hz, self._pack = rate_hz, pack
        self._env_info: EnvInfo | None = None
        self._open_loop: OpenLoopEnv | None = None

    def play(self, number: int, task: str, scene: SceneRecord, arrays: Mapping[str, NDArray]) -> EpisodeReplay:
        seed, reason = one_seed(scene.seed), _not_playable(scene, arrays)
        if seed is None or reason:
            return EpisodeReplay(number, task, None, skipped=reason)
        if self._open_loop is None or scene.env_info != self._env_info:
            self.close()
            env = read_env(scene.env_info and scene.env_info.model_dump(), "scene.json, env_info", pack=self._pack)
            self._env_info, self._open_loop = scene.env_info, OpenLoopEnv(env, self._rate_hz)
        self._open_loop.reset(seed, read_reset_options(scene.reset_options, "reset_options"))
        other = _other_scene(scene.layout or Layout(), self._open_loop)
        if other:
            return EpisodeReplay(number, task, None, skipped=f"its seed builds another scene now: {other}")
        played = self._open_loop.replay(episode_actions(arrays)[:-1])
        error = np.linalg.norm(played.tcp_in_base - arrays["ee_pos"], axis=1)
        return EpisodeReplay(number, task, played.success, float(error.mean()), float(error.max()), played.clipped)

    def close(self) -> None:
        if self._open_loop is not None:
            self._open_loop.close()
            self._open_loop = None


def _other_scene(recorded: Layout, open_loop: OpenLoopEnv) -> str:
    built = open_loop.layout
    if recorded.object_ids and recorded.object_ids != list(built.object_ids):
        return "other objects"
    for what, there, poses in (
        ("objects", recorded.poses, built.object_poses),
        ("the robot", recorded.robot_pose, built.robot_pose),
        ("the basket", recorded.basket_pose, built.basket_pose),
    ):
        if there and poses is not None:
            places = np.reshape(there, (-1, 7))[:, :3] - np.reshape(poses, (-1, 4, 4))[:, :3, 3]
            apart = np.linalg.norm(places, axis=1).max()
            if apart > _SAME_PLACE:
                return f"{what} up to {apart * 1000:.0f} mm away"
    return ""


def _not_playable(scene: SceneRecord, arrays: Mapping[str, NDArray]) -> str:
    if not scene.env_info or one_seed(scene.seed) is None:
        return "its scene.json does not say how to build the scene"
    if scene.success is False:
        return "it was recorded without success"
    if scene.recorded and scene.recorded.intervention is not None:
        return "it begins where another policy was, to which its seed does not lead"
    if len(arrays["ee_pos"]) < 2:
        return "it has no actions"
    if not all(np.isfinite(arrays[key]).all() for key in ("rel_pos", "rel_orn", "ee_pos", "base_pos")):
        return "its arrays hold NaN or infinity"  # which the simulation would keep
    base = arrays["base_pos"]
    if np.linalg.norm(base - base[0], axis=1).max() > _BASE_STILL:
        return "its base drives, which 7-D actions leave out"
    return ""
