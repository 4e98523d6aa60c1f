"""`keyframe`: a next-best-pose policy on RGB-D images.

It segments images, ranks grasps by their predicted success, and moves between keyframes by inverse kinematics.
"""

from __future__ import annotations

from robocas_ms3.baselines.baseline import Baseline
from robocas_ms3.baselines.keyframe.config import KeyframeConfig
from robocas_ms3.baselines.keyframe.data import KeyframeSamples
from robocas_ms3.baselines.keyframe.network import KeyframeNetwork
from robocas_ms3.baselines.keyframe.policy import KeyframePolicy

BASELINE = Baseline("keyframe", 1, KeyframeConfig, KeyframeNetwork, KeyframePolicy, KeyframeSamples)
