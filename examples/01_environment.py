"""Make an environment, print its instruction, step it, and print the stages of the task. Needs no renderer."""

import gymnasium as gym
import numpy as np

import robocas_ms3  # noqa: F401  (registers the environments)

# Observations are a dictionary of states; actions move the gripper. Nothing is rendered.
env = gym.make("RoboCASPick-v1", obs_mode="state_dict", control_mode="pd_ee_delta_pose", render_backend="none")
obs, info = env.reset(seed=0)
print(env.unwrapped.get_language_instruction()[0])

# An action has 7 numbers: translation (3) and rotation (3) in the gripper's frame, -1 to 1, and the gripper (1 = open).
# This action moves the open gripper forward along its approach axis.
action = np.array([0, 0, 1, 0, 0, 0, 1], dtype=np.float32)
for _ in range(10):  # half a second at 20 Hz
    obs, reward, terminated, truncated, info = env.step(action)
# Each stage is a boolean in `info`, one value per environment.
stages = ("reached_any", "picked_any", "reached_target", "target_grasped", "target_in_basket", "success")
print({stage: bool(info[stage][0]) for stage in stages})
env.close()
