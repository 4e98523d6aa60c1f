"""Further views of a decision: the gripper camera at random poses above the objects."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

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
_TRIES, _POSES = 10, 64  # points per view, and camera poses per point
_NEAREST = 8  # camera poses with the smallest joint motion, of which one is drawn
_STREAM = 418  # random stream of the views
_QPOS = 13  # first joint angle in the state of an articulation, after its pose and velocities


def name_view(number: int) -> str:
    """Return the name of the camera of a view, from number 0 on."""
    return f"view_{number + 1}_camera"


class HandViews:
    """Arm configurations from which the gripper camera views the objects.

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
            objects = decisions["object_in_base"][row][decisions["present"][row] & ~decisions["fallen"][row]][:, :3]
            qpos = self._draw(objects.astype(np.float64), states[index, arm].astype(np.float64), model, number, rng)
            if qpos is not None:
                states[index, arm] = qpos
        articulations = {**recording.states["articulations"], uid: states}
        return replace(recording, states={**recording.states, "articulations": articulations})

    def _draw(
        self, objects: Array, qpos: Array, model: CameraModel, number: int, rng: np.random.Generator
    ) -> Array | None:
        """Draw the configuration (7,) of a view; the first view shows the middle of the objects (n, 3)."""
        for _ in range(_TRIES if len(objects) else 0):
            point = objects.mean(axis=0) if number == 0 else objects[rng.integers(len(objects))]
            point = point + [*rng.normal(0, _SPREAD, 2), 0.0]
            poses = sample_views(rng, point, _FIRST_DISTANCE if number == 0 else _DISTANCE, _POSES)
            reachable, found = self._kinematics.nearest_solutions(
                poses @ OPENCV_IN_SAPIEN @ inverse(model.camera_in_parent), qpos
            )
            if reachable.any():
                found = found[reachable]
                nearest = found[np.argsort(joint_distance(found, qpos), kind="stable")[:_NEAREST]]
                return nearest[rng.integers(len(nearest))]
        return None
