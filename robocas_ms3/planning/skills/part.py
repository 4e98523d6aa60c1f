"""The door or drawer that a task wants opened: where its joint, its handle and its surface are."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from mani_skill.utils.structs import Articulation
from scipy.spatial.transform import Rotation

from robocas_ms3.assets.kinematics import joint_motion
from robocas_ms3.assets.manifest import Handle, Joint
from robocas_ms3.core.errors import PlanningFailed
from robocas_ms3.core.poses import inverse
from robocas_ms3.planning.protocol import Array, Obstacle
from robocas_ms3.planning.scene import SPACING, shape_of
from robocas_ms3.planning.skills.arm import Arm
from robocas_ms3.scenes.lookup import OPENED_AT_MOST
from robocas_ms3.tasks import terms
from robocas_ms3.tasks.bodies import contact_forces

LEAST_SHARE = 0.25  # of the joint's range; a pull that can't even do this is not worth it
STEP = {"prismatic": 0.015, "revolute": 0.03}  # m, rad between poses of a pull


@dataclass(frozen=True)
class Part:
    """What is opened: a moving part of a piece of furniture."""

    furniture: str
    handle: Handle
    joint: Joint

    @classmethod
    def of(cls, arm: Arm) -> Part:
        """The part that the task wants opened."""
        model = arm.env.model
        opening, joint = model.config.opening, model.opened_joint
        assert opening is not None  # the task has one
        assert joint is not None
        return cls(opening.furniture, model.furniture[opening.furniture].asset.handles[opening.handle], joint)

    @property
    def end(self) -> float:
        """Limit of the joint that it opens towards, m or rad."""
        return max(self.joint.limits, key=abs)

    def position(self, arm: Arm) -> float:
        """Where the joint stands, m or rad."""
        return arm.scene.joint_positions(self.furniture)[self.joint.name]

    def way(self, arm: Arm) -> Array:
        """Joint positions (T,) of a pull, from where the joint stands to where a pull ends at most."""
        start, far = self.position(arm), OPENED_AT_MOST[self.joint.kind] * self.end
        left = (far - start) * np.sign(far)
        if left < STEP[self.joint.kind]:
            raise PlanningFailed("pull", "at_the_end")
        return np.linspace(start, far, int(np.ceil(left / STEP[self.joint.kind])) + 1, dtype=np.float64)

    def least(self, arm: Arm) -> float:
        """How far a pull has to lead to be worth it, m or rad."""
        way = self.way(arm)
        return min(LEAST_SHARE * abs(self.end), abs(way[-1] - way[0]))

    def in_world(self, arm: Arm, positions: Array) -> Array:
        """4x4 poses (T, 4, 4) of the part's frame in the world, at joint positions (T,)."""
        frame = arm.env.model.furniture_poses[self.furniture]
        return np.array([frame @ joint_motion(self.joint, float(q)) for q in positions])

    def in_base(self, arm: Arm, positions: Array) -> Array:
        """The same in the arm's base frame."""
        return inverse(arm.scene.arm_base_in_world) @ self.in_world(arm, positions)

    def obstacle(self, arm: Arm, pose_in_base: Array) -> Obstacle:
        """The part as a body at a pose (4x4)."""
        part = arm.env.model.furniture[self.furniture].links[self.handle.link]
        return Obstacle(self.handle.link, shape_of(part), pose_in_base)

    def surface(self, arm: Arm) -> Array:
        """Samples (P, 3) of the part's surface in its own frame, m."""
        return arm.env.model.furniture[self.furniture].links[self.handle.link].surface_points(SPACING)

    @property
    def hold(self) -> Array:
        """4x4 TCP that holds the handle squarely, in the part's frame."""
        w, x, y, z = self.handle.wxyz
        pose = np.eye(4)
        pose[:3, :3], pose[:3, 3] = Rotation.from_quat([x, y, z, w]).as_matrix(), self.handle.position
        return pose

    def pressed(self, arm: Arm) -> bool:
        """Whether both fingers press on the part."""
        env = arm.env
        furniture = env.fixtures.furniture[self.furniture]
        assert isinstance(furniture, Articulation)
        link = furniture.links_map[self.handle.link]
        left, right = env.agent.finger1_link, env.agent.finger2_link
        forces = contact_forces(env.scene, [left, right], [link])
        closing = left.pose.to_transformation_matrix()[:, :3, 1]
        return bool(terms.finger_grasps(forces[:, 0], forces[:, 1], closing)[0, 0])
