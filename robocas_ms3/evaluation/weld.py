"""RoboCAS-v0's weld: an object that closed fingers have lifted is fixed to the hand until the gripper opens.

The evaluator of the paper does this, and it helps policies that drop lifted objects. So it is an option (`robocas eval
--weld`), off by default, that a result names. RoboCAS-v0 lets go at the end of the step in which the gripper was
commanded to open; here it is released when it begins to open.
"""

from __future__ import annotations

from typing import Any

import sapien
import torch

from robocas_ms3.core.errors import EvaluationError
from robocas_ms3.tasks import terms

RAISED = 0.03  # m above where it stood (evaluation_v0.md)
# Of the drive that keeps the rotation: 1/s^2 and 1/s, so that it is as stiff for a strawberry as for a bottle. Limits
# of no width lock the translation; those of angles SAPIEN 3.0.3 does not keep.
_STIFFNESS, _DAMPING = 1e8, 1e5


def check_weld(stepping: str, backend: str) -> None:
    """Check that objects can be welded with a protocol's steps, on a backend.

    Raises:
        EvaluationError: the protocol's steps are not upstream's, or envs run on a GPU.
    """
    if stepping != "upstream":
        what, fix = "the weld belongs to upstream's steps", "Leave --weld out, or take paper-v1."
        raise EvaluationError(what, where="--weld", expected="stepping upstream", found=stepping, fix=fix)
    if backend == "gpu":  # where nothing can be built once a batch runs
        what, fix = "nothing can be welded on a GPU", "Pass --backend processes."
        raise EvaluationError(what, where="--weld", found=backend, fix=fix)


class Weld:
    """Welds at most one object to the hand of a RoboCAS environment with one env on a CPU."""

    def __init__(self, env: Any) -> None:
        self._env = env
        self._welded: tuple[Any, Any] | None = None  # body and drive
        self._count = 0

    def update(self) -> None:
        """Weld an object that both fingers touch, if it is raised and nothing is welded.

        To be called after a policy step in which the gripper was commanded to close, as RoboCAS-v0 does.
        """
        if self._welded is not None:
            return
        env = self._env
        forces = env.gripper_forces()
        touched = terms.touched(forces[:, :1]) & terms.touched(forces[:, 1:2])  # by the left finger, by the right
        raised = env.object_poses[..., 2] - env.start_poses[..., 2] >= RAISED
        found = (touched & raised & env.present)[0].nonzero()
        if len(found):
            self._fix(env.objects[int(found[0])]._bodies[0])

    def open(self) -> None:
        """Release the object."""
        if self._welded is None:
            return
        body, drive = self._welded
        body.entity.remove_component(drive)
        body.wake_up()
        self._welded = None

    def reset(self) -> None:
        """Release the object, and count from 0; to be called before a reset, which may remove the objects."""
        self.open()
        self._count = 0

    def read(self, info: dict[str, Any]) -> dict[str, Any]:
        """Return entries of an info: the number of ``welds`` (1,), and no ``success`` while anything is welded."""
        welded = torch.tensor([self._welded is not None])
        return {"welds": torch.tensor([float(self._count)]), "success": info["success"] & ~welded}

    def _fix(self, body: Any) -> None:
        hand = self._env.agent.hand_link._bodies[0]
        drive = sapien.physx.PhysxDriveComponent(body)
        drive.parent = hand
        drive.pose_in_parent, drive.pose_in_child = hand.entity_pose.inv() * body.entity_pose, sapien.Pose()
        for lock in (drive.set_limit_x, drive.set_limit_y, drive.set_limit_z):
            lock(0.0, 0.0)
        drive.set_drive_property_slerp(_STIFFNESS, _DAMPING, mode="acceleration")
        body.entity.add_component(drive)
        self._welded = body, drive
        self._count += 1
