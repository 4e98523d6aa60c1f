"""Vector environments with short episodes in processes, and wrappers that fail for given actions."""

import os
import signal
import threading
import time

import gymnasium as gym
import numpy as np
import torch

import robocas_ms3
from robocas_ms3.core.errors import LayoutError

STATE_ONLY = {"render_backend": "none", "control_mode": "pd_joint_delta_pos", "obs_mode": "state"}
HORIZON = 4


def set_gpu_available(monkeypatch, there: bool) -> None:
    monkeypatch.setattr(torch.cuda, "is_available", lambda: there)


def make_short_vec(num_envs: int, workers: int, **kwargs):
    kwargs = {"backend": "processes", "max_episode_steps": HORIZON, **STATE_ONLY, **kwargs}
    return robocas_ms3.make_vec("RoboCASPick-v1", num_envs, workers=workers, **kwargs)


def make_actions(*what: int) -> np.ndarray:
    """Return one action per env that has this number as its first component, and zeros."""
    actions = np.zeros((len(what), 8), np.float32)
    actions[:, 0] = what
    return actions


def wait_for_end(pids: list[int]) -> bool:
    """Wait for the end of processes; return whether all ended within 5 s, without zombies."""
    for _ in range(100):
        if not any(os.path.exists(f"/proc/{pid}") for pid in pids):
            return True
        time.sleep(0.05)
    return False


class CustomError(Exception):
    """Error of a custom wrapper, with two arguments."""

    def __init__(self, what: str, code: int) -> None:
        super().__init__(what, code)


class UnpicklableError(Exception):
    """Error that can be pickled but not unpickled."""

    def __init__(self, what: str, where: str) -> None:
        super().__init__(f"{what} {where}")


class MisbehavingWrapper(gym.Wrapper):
    """Wrapper with a fault that the first number of the action selects.

    2: an error. 3: an error that can't be unpickled. 4: SIGKILL. 5: a delay of 3 s. 6: a lock in the info. 7: a delay
    of an hour. 8: KeyboardInterrupt.
    """

    def step(self, action):
        what = round(float(action[0]))
        if what == 2:
            raise CustomError("gripper fell off", 7)
        if what == 3:
            raise UnpicklableError("lost", "somewhere")
        if what == 4:
            os.kill(os.getpid(), signal.SIGKILL)
        if what == 8:
            raise KeyboardInterrupt
        if what in (5, 7):
            time.sleep(3 if what == 5 else 3600)
        *result, info = self.env.step(action)
        return *result, {**info, "lock": threading.Lock()} if what == 6 else info


class CrashingWrapper(gym.Wrapper):
    def __init__(self, env):
        os.kill(os.getpid(), signal.SIGSEGV)


class SucceedingWrapper(gym.Wrapper):
    """Wrapper whose ``success`` is true only at step 2, if the first number of the action is positive."""

    def step(self, action):
        obs, _, _, truncated, info = self.env.step(action)
        won = (info["elapsed_steps"] == 2) & bool(action[0] > 0)
        info = {**info, "success": won, "note": f"step {int(info['elapsed_steps'])}", "more": torch.ones(1, 2)}
        if won:
            info["of_some"] = torch.ones(1)
        return obs, won.float(), won.clone(), truncated, info


class MissingLayoutsWrapper(gym.Wrapper):
    """Wrapper without a layout for seed 5 and for some resets without a seed.

    After the seed ``draws_none_after``, every second reset without a seed has no layout.
    """

    def __init__(self, env):
        super().__init__(env)
        self.times = 0
        base, layouts = env.unwrapped, env.unwrapped.seeds.layouts

        def find_layout_or_fail(objects, seed):
            if seed == 5:
                raise LayoutError("no object qualifies as the target", where="layout")
            return layouts(objects, seed)

        base.seeds.layouts = find_layout_or_fail

    def reset(self, *, seed=None, options=None):
        if seed is None and self.unwrapped._main_seed[0] == options.get("draws_none_after"):
            self.times += 1
            if self.times % 2:
                raise LayoutError("none was drawn", where="layout")
        return self.env.reset(seed=seed, options=options)
