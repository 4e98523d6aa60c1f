"""Build a PhysX scene with one piece of furniture with a fixed body and free joints."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import sapien
from sapien import physx

from asset_tools.sources import FurnitureSource
from robocas_ms3.assets.kinematics import joint_frame
from robocas_ms3.assets.manifest import Handle, Link, Surface
from robocas_ms3.assets.pack import LoadedFurniture
from robocas_ms3.assets.physics import add_component, make_scene, make_shape, pose_matrix
from robocas_ms3.core.errors import AssetError

Array = np.ndarray


@dataclass(frozen=True)
class FurnitureModel:
    """Properties of furniture that the tests need.

    Attributes:
        pieces: name of a link -> corners (V, 3) of each hull, m; the fixed body has an empty name.
        links: moving parts; each parent is before its children.
        surfaces: name -> surface on which objects can be placed.
        handles: name -> grasp of a moving part.
        friction: friction coefficient of all parts.
    """

    pieces: dict[str, list[Array]]
    links: tuple[Link, ...]
    surfaces: Mapping[str, Surface]
    handles: Mapping[str, Handle]
    friction: float


def make_furniture_model(furniture: FurnitureSource | LoadedFurniture) -> FurnitureModel:
    """Return the properties of furniture, given by its source or loaded from a pack."""
    if isinstance(furniture, LoadedFurniture):
        facts = furniture.asset
        pieces = {"": furniture.hulls} | {name: part.hulls for name, part in furniture.links.items()}
        return FurnitureModel(pieces, facts.links, facts.surfaces, facts.handles, facts.friction)
    pieces = {"": furniture.pieces} | {link.name: link.pieces for link in furniture.links}
    return FurnitureModel(
        pieces,
        tuple(link.to_link() for link in furniture.links),
        furniture.surfaces,
        furniture.handles,
        furniture.friction,
    )


class FurnitureScene:
    """A scene with one piece of furniture, whose body is fixed and whose frame is the world frame.

    Args:
        model: the furniture.
        positions: name of a joint -> initial position in m or rad; other joints start closed, at 0.
    """

    def __init__(self, model: FurnitureModel, positions: Mapping[str, float] | None = None) -> None:
        self.scene = make_scene()
        self.material = physx.PhysxMaterial(model.friction, model.friction, 0.0)
        self.links: dict[str, physx.PhysxArticulationLinkComponent] = {}
        if not model.links:
            ground = physx.PhysxRigidStaticComponent()
            self._attach(ground, model.pieces[""])
            add_component(self.scene, ground, sapien.Pose())
            return
        root = physx.PhysxArticulationLinkComponent()
        self._attach(root, model.pieces[""])
        root.joint.type = "fixed"
        self.links[""] = root
        for link in model.links:
            self.links[link.name] = self._link(link, model.pieces[link.name])
        for part in self.links.values():
            add_component(self.scene, part, sapien.Pose())
        self.articulation = root.articulation
        # the engine orders joints differently
        self.order = {joint.name: index for index, joint in enumerate(self.articulation.active_joints)}
        wanted = np.zeros(len(self.order), np.float32)
        for name, position in (positions or {}).items():
            wanted[self.order[name]] = position
        self.articulation.qpos = wanted

    def _link(self, link: Link, pieces: Sequence[Array]) -> physx.PhysxArticulationLinkComponent:
        part = physx.PhysxArticulationLinkComponent(self.links[link.parent])
        self._attach(part, pieces)
        part.mass = link.mass
        part.cmass_local_pose = sapien.Pose(link.center_of_mass, link.inertia_wxyz)
        part.set_inertia(link.inertia)
        frame = sapien.Pose(joint_frame(link.joint))
        part.joint.name = link.joint.name
        part.joint.type = link.joint.kind
        part.joint.pose_in_parent = part.joint.pose_in_child = frame
        part.joint.limit = np.asarray(link.joint.limits, np.float32)
        part.joint.set_drive_property(0, link.joint.damping)
        part.joint.set_friction(link.joint.friction)
        return part

    def _attach(self, component: physx.PhysxRigidBaseComponent, pieces: Sequence[Array]) -> None:
        for piece in pieces:
            try:
                component.attach(make_shape(piece, self.material))
            except RuntimeError as error:
                fix = "Simplify the collision mesh."
                raise AssetError("PhysX cannot build a convex hull", found=error, fix=fix) from error

    def get_joint_position(self, joint: str) -> float:
        """Return the position of a joint in m or rad."""
        return float(self.articulation.qpos[self.order[joint]])

    def get_joint_speed(self, joint: str) -> float:
        """Return the velocity of a joint in m/s or rad/s."""
        return float(self.articulation.qvel[self.order[joint]])

    def get_link_pose(self, link: str) -> Array:
        """Return the pose (4, 4) of a link in the world frame."""
        return pose_matrix(self.links[link]) if self.links else np.eye(4)
