"""Replay the actions of each episode open loop in its rebuilt scene."""

from __future__ import annotations

import json
from collections.abc import Callable
from contextlib import closing
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from robocas_ms3.core.errors import RobocasError
from robocas_ms3.core.words import one_line
from robocas_ms3.datasets.actions import episode_actions
from robocas_ms3.datasets.sources.reader import Dataset, Episode
from robocas_ms3.demos.open_loop import OpenLoop
from robocas_ms3.demos.recordings.entries import one_seed, read_reset_options, was_taken_over
from robocas_ms3.demos.recordings.environment import read_env

_SAME_PLACE = 1e-3  # m
_BASE_STILL = 1e-3  # m that the base may move in all: 7-D actions do not move it


@dataclass(frozen=True)
class EpisodeReplay:
    """Outcome of one episode.

    Attributes:
        number: of the episode.
        task: pick, select, ...; empty: unknown.
        success: whether the task succeeded again; None: the episode was not replayed.
        mean_error, max_error: distance of the TCP from the recorded one, m.
        clipped: number of actions that exceed the limits of ``pd_ee_delta_pose``.
        skipped: why it was not replayed.
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
        """Return the report of ``--json``."""
        return {"by_task": self.by_task(), "episodes": [asdict(episode) for episode in self.episodes]}


def replay_dataset(
    root: str | Path,
    *,
    pack: str | Path | None = None,
    on_episode: Callable[[EpisodeReplay, int], None] = lambda episode, count: None,
) -> ReplayReport:
    """Replay the 7-D actions of a RoboCAS folder with ``pd_ee_delta_pose`` at the rate of the dataset.

    Args:
        root: folder of the dataset.
        pack: name or folder of the object pack, instead of the recorded one.
        on_episode: called with each outcome and the number of episodes.

    Raises:
        DatasetError: there is no dataset, or actions can't be replayed at its rate.
    """
    dataset = Dataset(Path(root))
    replays = []
    with closing(_Player(dataset.rate_hz, pack)) as player:
        for number in dataset.numbers:
            replays.append(player.play(number, dataset.episode(number)))
            on_episode(replays[-1], len(dataset.numbers))
    return ReplayReport(replays)


class _Player:
    """Keeps the environment as long as it is the same."""

    def __init__(self, rate_hz: float, pack: str | Path | None) -> None:
        self._rate_hz, self._pack = rate_hz, pack
        self._key, self._open_loop = "", None

    def play(self, number: int, episode: Episode) -> EpisodeReplay:
        task = ""
        try:
            scene = episode.scene
            task = str(scene.get("task") or "")
            seed, reason = one_seed(scene.get("seed")), _not_playable(episode)
            if seed is None or reason:
                return EpisodeReplay(number, task, None, skipped=reason)
            arrays = episode.arrays
            open_loop = self._environment(scene["env_info"])
            open_loop.reset(seed, read_reset_options(scene.get("reset_options"), "reset_options"))
            other = _other_scene(scene, open_loop)
            if other:
                return EpisodeReplay(number, task, None, skipped=f"its seed builds another scene now: {other}")
            played = open_loop.play(episode_actions(arrays)[:-1])
            error = np.linalg.norm(played.tcp_in_base - arrays["ee_pos"], axis=1)
        except (RobocasError, ValueError, TypeError, KeyError, IndexError, AttributeError, OSError) as error:
            return EpisodeReplay(number, task, None, skipped=one_line(error))
        return EpisodeReplay(
            number, task, played.success, float(error.mean()), float(error.max()), clipped=played.clipped
        )

    def _environment(self, env_info: dict[str, Any]) -> OpenLoop:
        key = json.dumps(env_info, sort_keys=True)
        if self._open_loop is None or key != self._key:
            self.close()
            env = read_env(env_info, "scene.json, env_info", pack=self._pack)
            self._key, self._open_loop = key, OpenLoop(env, self._rate_hz)
        return self._open_loop

    def close(self) -> None:
        if self._open_loop is not None:
            self._open_loop.close()
            self._open_loop = None


def _other_scene(scene: dict[str, Any], open_loop: OpenLoop) -> str:
    """Return what differs between a rebuilt and the recorded scene; empty: nothing."""
    recorded, built = scene.get("layout") or {}, open_loop.layout
    if "object_ids" in recorded and list(recorded["object_ids"]) != list(built.object_ids):
        return "other objects"
    for key, what, poses in (
        ("poses", "objects", built.object_poses),
        ("robot_pose", "the robot", built.robot_pose),
        ("basket_pose", "the basket", built.basket_pose),
    ):
        if recorded.get(key) and poses is not None:
            places = np.reshape([pose[:3] for pose in np.atleast_2d(recorded[key])], (-1, 3)).astype(np.float64)
            apart = np.linalg.norm(places - np.reshape(poses, (-1, 4, 4))[:, :3, 3], axis=1).max()
            if apart > _SAME_PLACE:
                return f"{what} up to {apart * 1000:.0f} mm away"
    return ""


def _not_playable(episode: Episode) -> str:
    scene = episode.scene
    if not scene.get("env_info") or one_seed(scene.get("seed")) is None:
        return "its scene.json does not say how to build the scene"
    if scene.get("success") is False:
        return "it was recorded without success"
    if was_taken_over(scene):
        return "it begins where another policy was, to which its seed does not lead"
    if len(episode.arrays["ee_pos"]) < 2:
        return "it has no actions"
    if not all(np.isfinite(episode.arrays[key]).all() for key in ("rel_pos", "rel_orn", "ee_pos", "base_pos")):
        return "its arrays hold NaN or infinity"  # which the simulation would keep
    base = episode.arrays["base_pos"]
    if np.linalg.norm(base - base[0], axis=1).max() > _BASE_STILL:
        return "its base drives, which 7-D actions leave out"
    return ""
