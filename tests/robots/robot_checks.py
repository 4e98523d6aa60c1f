"""Motions between poses, and poses straight from the URDF's XML, so that the simulator is not trusted about itself."""

from __future__ import annotations

import xml.etree.ElementTree as ET
from pathlib import Path

import numpy as np
from mani_skill.utils.structs import Pose
from scipy.spatial.transform import Rotation


def matrix(pose: Pose) -> np.ndarray:
    return pose.sp.to_transformation_matrix()


def moved(start: np.ndarray, end: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Translation and rotation vector of a motion, in the frame at its start."""
    relative = np.linalg.inv(start) @ end
    return relative[:3, 3], Rotation.from_matrix(relative[:3, :3]).as_rotvec()


def numbers(text: str) -> np.ndarray:
    return np.array([float(value) for value in text.split()])


def transform(xyz, rotation) -> np.ndarray:
    matrix = np.eye(4)
    matrix[:3, 3], matrix[:3, :3] = xyz, rotation.as_matrix()
    return matrix


def link_poses(urdf: Path, positions: dict[str, float]) -> dict[str, np.ndarray]:
    """4x4 pose of every link in the root's frame; joints not named are at 0."""
    joints = {}
    for joint in ET.parse(urdf).getroot().iterfind("joint"):
        origin = joint.find("origin")
        motion = np.eye(4)
        if joint.get("type") != "fixed":
            along = numbers(joint.find("axis").get("xyz")) * positions.get(joint.get("name"), 0.0)
            prismatic = joint.get("type") == "prismatic"
            motion = transform(along if prismatic else 0, Rotation.from_rotvec(along * (not prismatic)))
        rpy = numbers(origin.get("rpy", "0 0 0"))
        step = transform(numbers(origin.get("xyz")), Rotation.from_euler("xyz", rpy)) @ motion
        joints[joint.find("child").get("link")] = (joint.find("parent").get("link"), step)
    poses: dict[str, np.ndarray] = {}

    def pose(link: str) -> np.ndarray:
        if link not in poses:
            parent, step = joints.get(link, (None, np.eye(4)))
            poses[link] = step if parent is None else pose(parent) @ step
        return poses[link]

    for link in joints:
        pose(link)
    return poses
