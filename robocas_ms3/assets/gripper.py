"""The shape of the gripper that grasps are annotated for. Metres, TCP frame: z approach, y closing."""

import numpy as np

# The open gripper in the TCP frame, one half of it (the other is mirrored at y = 0): low and high corner, m. Upstream
# uses fingers 0.04..0.045 x +-0.01 x -0.09..0 and a palm +-0.1 x +-0.02 x -0.18..-0.09. These are the same parts of the
# Panda with 3 cm longer fingers: pads reach 8 mm beyond the TCP; knuckles and hand are wider and lower than upstream's.
GRIPPER_BOXES = np.array(
    [
        ((-0.010, 0.040, -0.040), (0.010, 0.046, 0.0085)),  # tip
        ((-0.012, 0.040, -0.075), (0.012, 0.067, -0.020)),  # knuckle
        ((-0.033, 0.000, -0.180), (0.033, 0.104, -0.067)),  # palm
    ]
)
GRIPPER_RADIUS = 0.22  # m from the TCP, holds all boxes
