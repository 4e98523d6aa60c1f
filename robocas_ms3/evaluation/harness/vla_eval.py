"""A benchmark of vla-eval 0.8, which names it ``robocas_ms3.evaluation.harness.vla_eval:RoboCAS``; docs/vla_eval.md.

It does not derive from vla-eval's class, so that this package does not need vla-eval. A task of vla-eval is a
configuration of the protocol, its episodes in the protocol's order.
"""

from __future__ import annotations

import sys
import time
from collections.abc import Mapping
from dataclasses import asdict
from typing import Any

import numpy as np
from numpy.typing import NDArray

from robocas_ms3.core.errors import EvaluationError
from robocas_ms3.evaluation.harness.proprioception import WIDTHS, Proprioception
from robocas_ms3.evaluation.metrics import MEASURES
from robocas_ms3.evaluation.outcomes import PAPER_STAGES
from robocas_ms3.evaluation.policy import ExternalPolicy, Observations
from robocas_ms3.evaluation.protocol import ProtocolEpisode
from robocas_ms3.evaluation.remote.messages import parse_actions, read_policy_spec
from robocas_ms3.evaluation.session import EvaluationSession
from robocas_ms3.evaluation.settings import EvaluationSettings

# vla-eval's names of rotations
_ROTATIONS = {
    "robocas": (3, "euler_xyz"),
    "delta_euler": (3, "euler_xyz"),
    "delta_axis_angle": (3, "axis_angle"),
    "delta_quaternion": (4, "quaternion_wxyz"),
}


class RoboCAS:
    """The episodes of a protocol, for vla-eval's runners in mode ``sync``.

    Args:
        protocol: name of a bundled protocol, or its folder.
        cameras: (width, height) in pixels by camera, in the order in which a model server gets the images.
        convention: meaning of the actions, one of ``evaluation.policy.CONVENTIONS``.
        reference: what motions are relative to: ``tcp`` or ``target``.
        rate_hz: actions per second; None: the protocol's.
    """

    def __init__(
        self,
        protocol: str = "smoke",
        cameras: Mapping[str, list[int]] | None = None,
        convention: str = "robocas",
        reference: str = "target",
        rate_hz: float | None = None,
    ) -> None:
        said = {"cameras": dict(cameras or {}), "convention": convention, "reference": reference, "rate_hz": rate_hz}
        self._spec = read_policy_spec(said, "params")
        settings = EvaluationSettings(protocol=protocol, envs=1, backend="processes")
        self._session = EvaluationSession(ExternalPolicy(self._spec), settings)
        self._of_config: dict[str, list[ProtocolEpisode]] = {}
        for episode in self._session.protocol.episodes:
            self._of_config.setdefault(episode.config, []).append(episode)
        self._episode: ProtocolEpisode | None = None
        self._seen: Observations | None = None
        self._proprioception = Proprioception(self._session.protocol.rules.robot)
        self._recorder: Any = None
        self._started = 0.0  # clock time, s

    @classmethod
    def configure_render(cls, mode: str) -> dict[str, str]:
        """Return no variables: SAPIEN finds its render device."""
        return {}

    def get_tasks(self) -> list[dict[str, Any]]:
        """Return a task per configuration; its suite is the short name of our task."""
        return [
            {"name": config, "suite": episodes[0].task, "episodes": len(episodes)}
            for config, episodes in self._of_config.items()
        ]

    def get_metadata(self) -> dict[str, Any]:
        """Return ``max_steps`` of the longest task; others end by the protocol's rules."""
        tasks = {episode.task for episode in self._session.protocol.episodes}
        return {"max_steps": max(self._session.max_steps(task) for task in tasks)}

    def get_metric_keys(self) -> dict[str, str]:
        """Return the entries of results that are averaged over episodes."""
        names = ("success", "success_at_end", "success_v0", *PAPER_STAGES.values(), "seconds", *MEASURES)
        return dict.fromkeys(names, "mean")

    def get_action_spec(self) -> dict[str, Any]:
        from vla_eval.specs import DimSpec  # pyright: ignore[reportMissingImports]

        convention = self._spec.convention
        if convention not in _ROTATIONS:
            return {"joints": DimSpec("joints", 7, "absolute_joint_positions"), "gripper": _gripper(DimSpec)}
        size, turn = _ROTATIONS[convention]
        grip = DimSpec("gripper", 1, "binary_open_01", (0, 1)) if convention == "robocas" else _gripper(DimSpec)
        return {
            "position": DimSpec("position", 3, "delta_xyz", description="m, in the TCP's frame"),
            "rotation": DimSpec("rotation", size, turn, description="in the TCP's frame"),
            "gripper": grip,
        }

    def get_observation_spec(self) -> dict[str, Any]:
        from vla_eval.specs import IMAGE_RGB, LANGUAGE, DimSpec  # pyright: ignore[reportMissingImports]

        images = dict.fromkeys(["image", *self._spec.cameras] if self._spec.cameras else [], IMAGE_RGB)
        return {**images, "state": DimSpec("state", WIDTHS["agent_pos"], "robocas"), "language": LANGUAGE}

    def get_hold_action(self, last_action: dict[str, Any] | None) -> dict[str, Any]:
        """Refuse mode ``live``, in which clock time chooses the steps."""
        raise NotImplementedError("RoboCAS' protocols need mode sync")

    async def start_episode(self, task: Mapping[str, Any], recorder: Any = None) -> None:
        """Start the episode ``episode_idx`` of a task of `get_tasks`."""
        episodes, number = self._of_config[task["name"]], task["episode_idx"]
        if number >= len(episodes):
            what, expected = "the protocol has no more episodes of this task", f"{len(episodes)} at most"
            raise EvaluationError(what, where=task["name"], expected=f"episodes_per_task: {expected}", found=number + 1)
        episode = episodes[number]
        self._episode, self._recorder, self._started = episode, recorder, time.monotonic()
        self._seen = self._session.reset([episode.episode])
        self._proprioception.reset(self._session.observation)
        self._record()

    async def apply_action(self, action: Mapping[str, Any]) -> None:
        """Execute an action, or all of a chunk."""
        actions = parse_actions({"actions": action.get("actions", action.get("action"))}, self._spec.convention)
        self._seen = self._session.step(actions[None])
        self._record()

    async def get_observation(self) -> dict[str, Any]:
        """Return ``images`` (H, W, 3) uint8 by camera, ``state`` and ``task_description``.

        ``state`` (18,) float32 is ``observation.state`` of our LeRobot datasets.
        """
        seen = self._seen
        assert seen is not None  # vla-eval asks for no observation of an episode that has ended
        return {
            "images": {name: images[0] for name, images in seen.images.items()},
            "state": self._proprioception.read(0, self._session.observation, None)["agent_pos"],
            "task_description": seen.instructions[0],
        }

    async def is_done(self) -> bool:
        return self._seen is None

    async def get_time(self) -> float:
        return time.monotonic() - self._started

    async def get_result(self) -> dict[str, Any]:
        """Return the outcome of the episode, whether flags ever held, and what it was measured with."""
        outcome, episode = self._session.outcomes.get(0), self._episode
        if outcome is None or episode is None:
            what, fix = "the run ended an episode before the protocol does", "Leave max_steps out of the configuration."
            raise EvaluationError(what, where="max_steps", fix=fix)
        return {
            **{name: step is not None for name, step in outcome.flags.items()},
            **outcome.measures,
            **asdict(outcome),
            "instruction": episode.instruction,
            **self._session.run_record.model_dump(include={"protocol", "protocol_hash", "versions"}),
        }

    def cleanup(self) -> None:
        self._session.close()

    def render(self) -> NDArray[np.uint8] | None:
        """Return the first camera's image (H, W, 3); None without cameras."""
        images = self._seen.images if self._seen is not None else {}
        return next(iter(images.values()))[0] if images else None

    def _record(self) -> None:
        if self._recorder is not None:
            self._recorder.record_video(self.render())


def _gripper(spec: Any) -> Any:
    return spec("gripper", 1, "binary_close_negative", (-1, 1))


if "vla_eval" in sys.modules:  # `vla-eval test` asks whether a benchmark is derived from its own
    from vla_eval.benchmarks.base import Benchmark  # pyright: ignore[reportMissingImports]

    Benchmark.register(RoboCAS)
