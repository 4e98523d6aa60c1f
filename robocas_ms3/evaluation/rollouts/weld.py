"""RoboCAS-v0's weld of lifted objects to the hand."""

from __future__ import annotations

from typing import Any

import sapien
import torch

from robocas_ms3.core.errors import EvaluationError
from robocas_ms3.tasks import terms

RAISED_HEIGHT = 0.03  # m above the initial height
# The drive that holds the rotation, in acceleration units (1/s^2, 1/s): equally stiff for light and heavy objects.
# Limits of zero width lock the translation; SAPIEN 3.0.3 does not enforce angular limits.
_STIFFNESS, _DAMPING = 1e8, 1e5


class Weld:
    """RoboCAS-v0's weld: a drive that fixes at most one lifted object to the hand, for one env on the CPU.

    The evaluator of the paper uses the weld. The weld helps policies that drop lifted objects. This class releases the
    object when the gripper starts to open; RoboCAS-v0 releases it at the end of the step that opens the gripper.
    """

    def __init__(self, env: Any) -> None:
        self._env = env
        self._welded: tuple[Any, Any] | None = None  # body and drive
        self._count = 0

    def weld_touched_object(self) -> None:
        """Weld an object that both fingers touch and that is raised by 3 cm; do nothing if an object is welded.

        Must be called after each policy step that commands the gripper to close, as RoboCAS-v0 does.
        """
        if self._welded is not None:
            return
        env = self._env
        forces = env.gripper_forces()
        touched = terms.is_touched(forces[:, :1]) & terms.is_touched(forces[:, 1:2])  # by the left finger, by the right
        raised = env.object_poses[..., 2] - env.start_poses[..., 2] >= RAISED_HEIGHT
        found = (touched & raised & env.present)[0].nonzero()
        if len(found):
            self._attach_to_hand(env.objects[int(found[0])]._bodies[0])

    def release(self) -> None:
        """Release the welded object, if there is one."""
        if self._welded is None:
            return
        body, drive = self._welded
        body.entity.remove_component(drive)
        body.wake_up()
        self._welded = None

    def reset(self) -> None:
        """Release the welded object and set the number of welds to 0."""
        self.release()
        self._count = 0

    def compute_info(self, info: dict[str, Any]) -> dict[str, Any]:
        """Return the entries ``welds`` and ``success`` for ``info``.

        ``welds`` (1,) float32: number of welds since the reset. ``success`` (1,) bool: the value in ``info``, but
        False while an object is welded.
        """
        welded = torch.tensor([self._welded is not None])
        return {"welds": torch.tensor([float(self._count)]), "success": info["success"] & ~welded}

    def _attach_to_hand(self, body: Any) -> None:
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


def check_weld_available(stepping: str, backend: str) -> None:
    """Raise `EvaluationError` if the weld is not available with this stepping of a protocol and this backend."""
    if stepping != "upstream":
        what, fix = "the weld needs a protocol with RoboCAS-v0's steps", "Omit --weld, or pass --protocol paper-v1."
        found = f"stepping: {stepping}"
        raise EvaluationError(what, where="--weld", expected="stepping: upstream", found=found, fix=fix)
    if backend == "gpu":  # a running GPU batch accepts no new components
        what, fix = "the weld is not available on a GPU", "Pass --backend processes."
        raise EvaluationError(what, where="--weld", expected="backend processes", found=backend, fix=fix)
