"""A policy that is at the other end of a channel, and the environment that it sees."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from robocas_ms3.errors import WireError
from robocas_ms3.evaluation.actions import CONVENTIONS
from robocas_ms3.evaluation.bridge.channel import Channel
from robocas_ms3.evaluation.bridge.proprioception import WIDTHS, Proprioception
from robocas_ms3.evaluation.outcomes import Outcome
from robocas_ms3.evaluation.policy import Observations, Start, Wants
from robocas_ms3.robots.table import find_robot


class ObservationKeeper:
    """A vector environment that keeps what it showed last."""

    def __init__(self, env: Any) -> None:
        self._env, self.num_envs, self.obs = env, env.num_envs, {}

    def reset(self, **kwargs: Any) -> Any:
        """Reset; see the environment."""
        result = self._env.reset(**kwargs)
        self.obs = result[0]
        return result

    def step(self, actions: NDArray[np.floating]) -> Any:
        """Step; see the environment."""
        result = self._env.step(actions)
        self.obs = result[0]
        return result

    def close(self) -> None:
        """Close the environment."""
        self._env.close()


class Actor:
    """A policy that is elsewhere: tells the other end what is seen, and does what it says.

    Args:
        channel: to it.
        wants: what it sees, and what its actions mean.
        num_envs: of a batch.
    """

    def __init__(self, channel: Channel, wants: Wants, num_envs: int) -> None:
        self.wants = wants
        self.ended: dict[int, Outcome] = {}  # since the last report
        self._channel, self._convention = channel, CONVENTIONS[wants.convention]
        self._shape = (num_envs, self._convention.size)
        self._feels = Proprioception()
        self._watched: ObservationKeeper
        self._starts: dict[int, Start] = {}
        self._grippers: dict[int, float | None] = {}  # of envs that play, what they were told
        self._begins = True

    def begin(self, watched: ObservationKeeper) -> None:
        """Another batch, in an environment."""
        self._watched, self.ended, self._begins = watched, {}, True

    def reset(self, starts: list[Start]) -> None:
        """All of a batch's episodes begin at once."""
        self._starts = {start.env: start for start in starts}
        self._grippers = dict.fromkeys(self._starts)
        for env in self._starts:
            self._feels.begin(env, self._watched.obs, find_robot(self._starts[env].robot))

    def act(self, observations: Observations) -> NDArray[np.floating]:
        """Ask the other end; actions (E, A) of the envs that play.

        Raises:
            AbandonedBatch: it wants another batch.
            WireError: it says what is no action.
        """
        self.report()
        message = self._channel.receive()
        if "play" in message:
            raise AbandonedBatch(message)
        actions = message.get("act")
        if not isinstance(actions, np.ndarray) or actions.dtype.kind != "f" or actions.shape != self._shape:
            raise WireError("no actions", expected=f"{self._shape} numbers", found=str(message)[:200])
        grippers = actions[:, -1] if self._convention.read is None else np.where(self._opens(actions), 1.0, -1.0)
        self._grippers = {env: float(grippers[env]) for env in self._grippers}
        return actions[observations.envs]

    def report(self) -> None:
        """Say what the envs that play show, and which of them have ended."""
        envs, obs = sorted(self._grippers), self._watched.obs
        feels = [self._feels.read(env, obs, self._grippers[env]) for env in envs]
        message: dict[str, Any] = {
            "envs": envs,
            "numbers": {name: np.stack([one[name] for one in feels]) for name in WIDTHS},
            "images": {name: obs["sensor_data"][name]["rgb"][envs] for name in self.wants.cameras},
            "ended": [
                {"env": env, "success": outcome.success, "steps": outcome.steps, "error": outcome.error}
                for env, outcome in self.ended.items()
            ],
        }
        if self._begins:
            message["instructions"] = [self._starts[env].instruction for env in envs]
            message["episodes"] = [self._starts[env].episode for env in envs]
        self._channel.send(message)
        for env in self.ended:
            del self._grippers[env]
        self.ended, self._begins = {}, False

    def _opens(self, actions: NDArray[np.floating]) -> NDArray[np.bool_]:
        assert self._convention.read is not None
        return self._convention.read(np.nan_to_num(actions.astype(np.float64))).open


class AbandonedBatch(Exception):
    """The other end wants another batch in the middle of one.

    Args:
        message: with which it says so.
    """

    def __init__(self, message: dict[str, Any]) -> None:
        self.message = message
        super().__init__("a batch was abandoned")
