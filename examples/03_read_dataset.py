"""Convert a recording and read it as training data, as the loader of RoboCAS-v0: instruction, images and actions.

python examples/03_read_dataset.py TRAJECTORY.h5 OUT
"""

import json
import sys
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from robocas_ms3.datasets import ConversionSettings, Dataset, convert

if len(sys.argv) != 3:
    sys.exit("usage: python examples/03_read_dataset.py TRAJECTORY.h5 OUT")
trajectory, out = map(Path, sys.argv[1:])
convert(ConversionSettings(trajectory, out, rate_hz=5, embeddings=False, video=False, size=(320, 240), overwrite=True))

info = json.loads((out / "data_info.json").read_text())
low, high = map(np.array, info["action_space"]["relative_position"])  # 1st and 99th percentile
dataset = Dataset(out)
for number in dataset.numbers:
    episode = dataset.episode(number)
    arrays = episode.arrays
    print(f"{number}: {arrays['language_goal']} ({episode.steps} steps)")
    for step in range(episode.steps - 1):
        image = episode.rgb("gripper_camera", step)
        euler = Rotation.from_quat(arrays["rel_orn"][step]).as_euler("xyz")  # from xyzw; angles about fixed axes
        open_gripper = arrays["gripper_status"][step + 1]  # command between this step and the next
        action = np.concatenate([arrays["rel_pos"][step], euler, [open_gripper]])
        if step % 5 == 0:
            print(f"{step:4d} {arrays['step_goal_type'][step]:18s} {image.shape} {np.round(action, 3)}")
