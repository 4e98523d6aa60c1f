"""A vector environment without physics, for the loops that run episodes."""

from __future__ import annotations

from typing import Any

import numpy as np

from robocas_ms3.core.errors import VectorEnvCrashError
from robocas_ms3.evaluation.policy import EpisodeSpec, Policy
from robocas_ms3.evaluation.results.metrics import SUMS
from robocas_ms3.evaluation.rollouts.action_wrapper import CHECKPOINT
from robocas_ms3.evaluation.rollouts.rollout import EndConditions, EpisodeBatch, Rollout, run_rollouts
from robocas_ms3.robots.camera_models import CameraModel

STAGES = ("reached_any", "picked_any", "reached_target", "target_grasped", "target_lifted", "target_in_basket")
BREAKS = 13.0  # an action with this number raises
POSE = [1, 2, 3, 0.4, 0.1, 0.2, 0.3]  # m; quaternion wxyz


class CountingEnv:
    """N envs without physics; an env succeeds when the sum of its first action values, or of its steps, reaches a goal.

    Args:
        num_envs: N.
        goal: goal of all envs, or one per env; None: the seed of the episode.
        steps: whether steps are counted.
        config: name of the configuration, for tests.

    Attributes:
        records_checkpoints: whether the infos have checkpoints: states with the sum of each env.
    """

    records_checkpoints = False

    def __init__(self, num_envs: int = 1, goal: Any = 5.0, *, steps: bool = False, config: str = "") -> None:
        self.num_envs, self.config, self._goal, self._count_steps = num_envs, config, goal, steps
        self.resets, self.seeds, self.actions, self.rendered, self.closed = [], [], [], [], False
        self.sums, self.elapsed, self.seed_of = np.zeros(num_envs), np.zeros(num_envs, int), np.zeros(num_envs, int)

    def reset(self, *, seed: list[int], options: dict[str, Any]) -> tuple[Any, dict]:
        envs = list(options.get("env_idx", range(self.num_envs)))
        assert len(seed) == len(envs)
        self.resets.append(envs)
        self.seeds += seed
        self.sums[envs], self.elapsed[envs], self.seed_of[envs] = 0.0, 0, seed
        return self._observation(), self._info()

    def step(self, actions: np.ndarray) -> tuple:
        assert np.isfinite(actions).all()
        if (actions[:, 0] == BREAKS).any():
            raise RuntimeError("the env broke")
        self.actions.append(actions.copy())
        self.sums += 1 if self._count_steps else actions[:, 0]
        self.elapsed += 1
        return self._observation(), None, None, None, self._info()

    def render_images(self, envs: np.ndarray) -> dict[str, dict[str, np.ndarray]]:
        """Return images whose pixels are the elapsed steps plus 1."""
        self.rendered.append(envs.tolist())
        pixels = np.tile(self.elapsed[envs, None, None, None] + 1, (1, 4, 6, 3)).astype(np.uint8)
        return {"base_camera": {"rgb": pixels, "depth": pixels[..., :1].astype(np.int16) * 100}}

    def camera_models(self) -> list[dict[str, CameraModel]]:
        """Return a gripper camera 10 cm above the TCP; the true pose is shifted by the index of the env along x."""
        found = []
        for env in range(self.num_envs):
            nominal, true = np.eye(4), np.eye(4)
            nominal[2, 3] = true[2, 3] = -0.1
            true[0, 3] = env
            found.append({"base_camera": CameraModel(np.array([2.0, 2.0, 3.0, 2.0]), nominal, "ee", true)})
        return found

    def close(self) -> None:
        self.closed = True

    def _observation(self) -> dict[str, Any]:
        count = self.num_envs
        qpos = np.tile(np.arange(12, dtype=np.float32) + 10, (count, 1))
        tcp = np.tile(np.array(POSE, np.float32), (count, 1))
        width = np.full((count, 1), 0.05, np.float32)
        return {
            "agent": {"qpos": qpos, "qvel": qpos, "tcp_in_arm_base": tcp, "gripper_width": width},
            "extra": {"seed": self.seed_of[:, None].astype(np.float32), "tcp_pose": tcp},
        }

    def _info(self) -> dict[str, Any]:
        no, sums = np.zeros(self.num_envs, bool), np.zeros((self.num_envs, len(SUMS)), np.float32)
        sums[:, 0] = self.sums  # path_length
        done = self.sums >= (self.seed_of if self._goal is None else self._goal)
        flags = {**{stage: self.sums > 1 for stage in STAGES}, "success": done, "fail": no, "success_v0": no}
        checkpoint = {CHECKPOINT: sums[:, :1].copy()} if self.records_checkpoints else {}
        return {"sums": sums, **flags, "elapsed_steps": self.elapsed.copy(), **checkpoint}


class CrashingEnv(CountingEnv):
    """Envs whose worker crashes in the second step of a seed; ``deaths`` counts the remaining crashes."""

    def __init__(self, num_envs: int, seed: int, deaths: list[int]) -> None:
        super().__init__(num_envs, None)
        self.deadly, self.deaths = seed, deaths

    def step(self, actions: np.ndarray) -> tuple:
        at = [env for env in range(self.num_envs) if self.seed_of[env] == self.deadly and self.elapsed[env] == 1]
        if at and self.deaths[0] > 0:
            self.deaths[0] -= 1
            died = VectorEnvCrashError("its process died", found="SIGSEGV")
            died.envs = tuple(at)
            raise died
        return super().step(actions)


def run_policy(
    env: Any, policy: Policy, episodes: list[EpisodeSpec], max_steps: int, *, refill: bool = True
) -> list[Rollout]:
    """Run episodes with a policy, 0.05 s per step."""
    batch = EpisodeBatch(env, policy.spec, EndConditions(max_steps), 0.05, refill=refill)
    return list(run_rollouts(batch, policy, episodes))
