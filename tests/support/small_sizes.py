"""Sizes of the baseline `small` for tests, which train in seconds."""

from robocas_ms3.baselines.small.config import CameraView

VIEW = CameraView(image_size=(64, 48), size=(64, 48))
TINY = dict(
    views={"base_camera": VIEW, "gripper_camera": VIEW},
    chunk=3,
    channels=8,
    width=32,
    heads=2,
    layers=1,
    dropout=0.0,
    shift=0,
    brightness=0.0,
)
