"""Convert a recording to a RoboCAS dataset, and read it like the loader of RoboCAS-v0: instruction, images and actions.

python examples/03_read_dataset.py TRAJECTORY.h5 OUT
"""

import sys
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from robocas_ms3.datasets import ConversionSettings, Dataset, convert

if len(sys.argv) != 3:
    sys.exit("usage: python examples/03_read_dataset.py TRAJECTORY.h5 OUT")
trajectory, out = map(Path, sys.argv[1:])
# Render the recorded episodes at 5 Hz, and write one folder per episode.
convert(ConversionSettings(trajectory, out, rate_hz=5, embeddings=False, video=False, size=(320, 240), overwrite=True))

dataset = Dataset(out)
for number in dataset.numbers:
    episode = dataset.episode(number)
    arrays = episode.arrays  # name -> array with one row per step
    print(f"{number}: {arrays['language_goal']} ({episode.steps} steps)")
    for step in range(episode.steps - 1):
        image = episode.rgb("gripper_camera", step)  # (height, width, 3)
        # the motion of the gripper to the next step: translation in m, and angles about fixed axes in rad
        euler = Rotation.from_quat(arrays["rel_orn"][step]).as_euler("xyz")  # quaternion xyzw
        open_gripper = arrays["gripper_status"][step + 1]  # command of the gripper between both steps, 1 = open
        action = np.concatenate([arrays["rel_pos"][step], euler, [open_gripper]])
        if step % 5 == 0:
            print(f"{step:4d} {arrays['step_goal_type'][step]:18s} {image.shape} {np.round(action, 3)}")
