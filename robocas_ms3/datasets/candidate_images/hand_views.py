"""Further views of a decision: the gripper camera at random poses before or above the objects or a handle."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from robocas_ms3.core.errors import DatasetError
from robocas_ms3.core.poses import Array, inverse
from robocas_ms3.demos.candidates.candidates_file import CandidateFile
from robocas_ms3.demos.recordings.environment import RecordedEnv
from robocas_ms3.demos.recordings.trajectory_file import Recording
from robocas_ms3.planning.kinematics import ArmChain, InverseKinematics, joint_distance
from robocas_ms3.planning.skills.look import sample_views
from robocas_ms3.robots.camera_models import OPENCV_IN_SAPIEN, CameraModel

_DISTANCE, _FIRST_DISTANCE = (0.28, 0.5), (0.42, 0.55)  # m from the camera to the point that it views
_SPREAD = 0.04  # m, standard deviation of this point from an object
_FRONT_ELEVATION_DEG, _FRONT_AZIMUTH = (15.0, 55.0), 0.7  # of views from the front; rad to both sides
_TRIES, _POSES = 10, 64  # points per view, and camera poses per point
_NEAREST = 8  # camera poses with the smallest joint motion, of which one is drawn
_STREAM = 418  # random stream of the views
_QPOS = 13  # first joint angle in the state of an articulation, after its pose and velocities


def name_view(number: int) -> str:
    """Return the name of the camera of a view, from number 0 on."""
    return f"view_{number + 1}_camera"


class HandViews:
    """Arm configurations from which the gripper camera views the objects.

    The views are from above, or from the front if the objects are grasped from the front. Before a pull, they show the
    handle from the front.

    Args:
        env: environment of the decisions.

    Attributes:
        camera: name of the gripper camera.

    Raises:
        DatasetError: the robot has no camera on its hand.
    """

    def __init__(self, env: RecordedEnv) -> None:
        names = [camera.name for camera in env.cameras() if camera.mount == "hand"]
        if not names:
            raise DatasetError("views need a camera on the hand", where="--views", found=env.robot().description.uid)
        self.camera = names[0]
        robot = env.robot()
        self._description = robot.description
        self._kinematics = InverseKinematics(ArmChain(robot.files().arm_urdf, robot.description))
        self._is_front = env.task_config().target.approach == "front"

    def move_arm(
        self, file: CandidateFile, rows: tuple[int, int], recording: Recording, model: CameraModel, number: int
    ) -> Recording:
        """Return the recording of the decisions of a seed with the arm at the view ``number`` of each decision.

        The arm stays where no view is reachable, and where the gripper holds an object.

        Args:
            file: candidates file.
            rows: first row of the decisions, and the row after the last one.
            recording: one state per decision.
            model: model of the gripper camera.
        """
        uid, decisions = self._description.uid, file.decisions
        states = recording.states["articulations"][uid].copy()
        arm = slice(_QPOS + self._description.arm_slice.start, _QPOS + self._description.arm_slice.stop)
        for index, row in enumerate(range(*rows)):
            if decisions["held_slot"][row] >= 0:
                continue
            rng = np.random.default_rng([int(decisions["seed"][row]), int(decisions["decision"][row]), number, _STREAM])
            points = _find_handle_positions(file, row)
            is_front = self._is_front or len(points) > 0
            if not len(points):
                points = decisions["object_in_base"][row][decisions["present"][row] & ~decisions["fallen"][row]][:, :3]
            subject = _Subject(points.astype(np.float64), is_front, number == 0)
            qpos = self._draw(subject, states[index, arm].astype(np.float64), model, rng)
            if qpos is not None:
                states[index, arm] = qpos
        articulations = {**recording.states["articulations"], uid: states}
        return replace(recording, states={**recording.states, "articulations": articulations})

    def _draw(self, subject: _Subject, qpos: Array, model: CameraModel, rng: np.random.Generator) -> Array | None:
        """Draw the configuration (7,) of a view, near a configuration (7,)."""
        for _ in range(_TRIES if len(subject.points) else 0):
            poses = subject.draw_cameras(rng)
            reachable, found = self._kinematics.nearest_solutions(
                poses @ OPENCV_IN_SAPIEN @ inverse(model.camera_in_parent), qpos
            )
            if reachable.any():
                found = found[reachable]
                nearest = found[np.argsort(joint_distance(found, qpos), kind="stable")[:_NEAREST]]
                return nearest[rng.integers(len(nearest))]
        return None


@dataclass(frozen=True)
class _Subject:
    """What a view shows: one of the points (n, 3) in the arm's base frame, or the middle of all in the first view."""

    points: Array
    is_front: bool
    is_first: bool

    def draw_cameras(self, rng: np.random.Generator) -> Array:
        """Draw a point and camera poses (N, 4, 4) that view it."""
        points = self.points
        point = points.mean(axis=0) if self.is_first else points[rng.integers(len(points))]
        point = point + [*rng.normal(0, _SPREAD, 2), 0.0]
        distance, outward = _FIRST_DISTANCE if self.is_first else _DISTANCE, float(np.arctan2(point[1], point[0]))
        front = {}
        if self.is_front:
            azimuth = (outward - _FRONT_AZIMUTH, outward + _FRONT_AZIMUTH)
            front = {"elevation_deg": _FRONT_ELEVATION_DEG, "azimuth": azimuth}
        return sample_views(rng, point, distance, _POSES, **front)


def _find_handle_positions(file: CandidateFile, row: int) -> NDArray[np.float32]:
    """Return the positions (n, 3) at which successful pulls of a decision grasp the handle; n is 0 without a pull."""
    found = file.decision(row).candidates
    pulls = (found["primitive"] == "pull") & found["success"]
    return found["start_in_base"][pulls][:, :3]
