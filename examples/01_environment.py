"""Make an environment, print its instruction, step it, and print the stages of the task. Needs no renderer."""

import gymnasium as gym
import numpy as np

import robocas_ms3  # noqa: F401  (registers the environments)

env = gym.make("RoboCASPick-v1", obs_mode="state_dict", control_mode="pd_ee_delta_pose", render_backend="none")
obs, info = env.reset(seed=0)
print(env.unwrapped.get_language_instruction()[0])

# 7 numbers in the gripper's frame: translation and rotation as fractions of their limits, and the gripper (1 = open).
# This action moves along the approach axis of the gripper for half a second.
action = np.array([0, 0, 1, 0, 0, 0, 1], dtype=np.float32)
for _ in range(10):
    obs, reward, terminated, truncated, info = env.step(action)
stages = ("reached_any", "picked_any", "reached_target", "target_grasped", "target_in_basket", "success")
print({stage: bool(info[stage][0]) for stage in stages})
env.close()
