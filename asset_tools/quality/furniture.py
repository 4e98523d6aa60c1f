"""Furniture in the physics engine: whether its parts open and close, and things stay on it."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import sapien
from sapien import physx

from asset_tools.inertia import piece_inertia
from asset_tools.physics import TIME_STEP, add_component, cook, engine_settings, new_scene, pose_matrix
from asset_tools.quality.surfaces import BLOCKED, Probe, clearances, probes
from asset_tools.sources import FurnitureSource
from robocas_ms3.assets.hulls import convex_faces
from robocas_ms3.assets.kinematics import joint_frame, link_poses
from robocas_ms3.assets.manifest import FurnitureQuality, Handle, Link, Surface
from robocas_ms3.assets.pack import LoadedFurniture
from robocas_ms3.errors import AssetError

Array = np.ndarray

FORCE = 30.0  # N at the handle, about what the arm can do
HAND_SPEED = 0.25  # m/s: the hand pushes less the nearer the handle comes to it
OPEN, CLOSED = 0.9, 0.05  # shares of the range
STILL = 0.01  # share of the range that a part left alone may move in a second
FASTEST = {"prismatic": 2.0, "revolute": 10.0}  # m/s, rad/s: nothing a hand of this speed could cause
MOVED, SPEED = 0.01, 0.01  # m, m/s: what a thing put down may do
PROBE_DENSITY = 500.0  # kg/m3


@dataclass(frozen=True)
class JointReport:
    """How a joint answers a force; shares of its range.

    Attributes:
        opened: how far it came.
        closed: where it ended when pushed back.
        drifted: how far it moved by itself within a second, closed.
        fastest: speed of any joint meanwhile, m/s or rad/s, infinite for no number.
        bounded: whether no joint was faster than a hand could make it.
    """

    opened: float
    closed: float
    drifted: float
    fastest: float
    bounded: bool

    @property
    def works(self) -> bool:
        """Whether it opens, closes and stays still."""
        return self.bounded and self.opened >= OPEN and abs(self.closed) <= CLOSED and self.drifted <= STILL


@dataclass(frozen=True)
class SurfaceReport:
    """What became of things put on a surface.

    Attributes:
        probes: how many were put there.
        moved: the farthest that one of them moved in a second, m.
        speed: of the fastest at the end, m/s.
        headroom: the least free height found above it, m; infinite under the open sky.
        enough: whether that is what the surface says.
    """

    probes: int
    moved: float
    speed: float
    headroom: float
    enough: bool

    @property
    def holds(self) -> bool:
        """Whether things stay on it, and there is as much room above it as it says."""
        return self.probes > 0 and self.moved < MOVED and self.speed < SPEED and self.enough


@dataclass(frozen=True)
class FurnitureReport:
    """What was measured of each joint and surface, by name."""

    joints: dict[str, JointReport]
    surfaces: dict[str, SurfaceReport]


@dataclass(frozen=True)
class _Model:
    pieces: dict[str, list[Array]]  # by link; "" is the fixed body
    links: tuple[Link, ...]
    surfaces: Mapping[str, Surface]
    handles: Mapping[str, Handle]
    friction: float


def measure_furniture(furniture: FurnitureSource | LoadedFurniture) -> FurnitureQuality:
    """Shares of joints that work and surfaces that hold. The same furniture gives the same figures.

    Raises:
        AssetError: the physics engine refuses a hull.
    """
    model = _model(furniture)
    report = _examine(model)
    hulls = [piece for pieces in model.pieces.values() for piece in pieces]
    return FurnitureQuality(
        hull_count=len(hulls),
        hull_vertices=max(len(convex_faces(hull)[0]) for hull in hulls),
        joints_open=_share(joint.works for joint in report.joints.values()),
        surfaces_hold=_share(surface.holds for surface in report.surfaces.values()),
    )


def examine_furniture(furniture: FurnitureSource | LoadedFurniture) -> FurnitureReport:
    """The same in detail: which joint sticks, which surface lets things slip.

    Raises:
        AssetError: the physics engine refuses a hull.
    """
    return _examine(_model(furniture))


def _examine(model: _Model) -> FurnitureReport:
    with engine_settings():
        return _examine_in_engine(model)


def _examine_in_engine(model: _Model) -> FurnitureReport:
    joints = {link.joint.name: _try_joint(model, link) for link in model.links}
    return FurnitureReport(joints, {name: _try_surface(model, surface) for name, surface in model.surfaces.items()})


def _share(flags: Iterable[bool]) -> float | None:
    found = list(flags)
    return sum(found) / len(found) if found else None


def _model(furniture: FurnitureSource | LoadedFurniture) -> _Model:
    if isinstance(furniture, LoadedFurniture):
        facts = furniture.asset
        pieces = {"": furniture.hulls} | {name: part.hulls for name, part in furniture.links.items()}
        return _Model(pieces, facts.links, facts.surfaces, facts.handles, facts.friction)
    pieces = {"": furniture.pieces} | {link.name: link.pieces for link in furniture.links}
    links = []
    for link in furniture.links:
        center, inertia, axes = piece_inertia(link.pieces, link.mass)
        links.append(
            Link(
                name=link.name,
                parent=link.parent,
                joint=link.joint,
                mass=link.mass,
                center_of_mass=tuple(center),
                inertia=tuple(inertia),
                inertia_wxyz=axes,
            )
        )
    return _Model(pieces, tuple(links), furniture.surfaces, furniture.handles, furniture.friction)


class _Stage:
    """A scene with the furniture in it, its body fixed, its frame the world's."""

    def __init__(self, model: _Model, positions: Mapping[str, float] | None = None) -> None:
        self.scene = new_scene()
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
        # the engine has an order of its own
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
        part.inertia = np.asarray(link.inertia, np.float32)
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
                component.attach(cook(piece, self.material))
            except RuntimeError as error:
                raise AssetError("the physics engine refused a convex hull", found=error) from error

    def position(self, joint: str) -> float:
        return float(self.articulation.qpos[self.order[joint]])

    def speed(self, joint: str) -> float:
        return float(self.articulation.qvel[self.order[joint]])

    def matrix(self, link: str) -> Array:
        return pose_matrix(self.links[link]) if self.links else np.eye(4)


def _try_joint(model: _Model, link: Link) -> JointReport:
    joint, stage = link.joint, _Stage(model)
    far = max(joint.limits, key=abs)
    fastest, bounded = 0.0, True

    def step() -> bool:
        nonlocal fastest, bounded
        stage.scene.step()
        for other in model.links:
            speed = abs(stage.speed(other.joint.name))
            if not np.isfinite(speed) or speed > FASTEST[other.joint.kind]:
                bounded = False
            fastest = max(fastest, speed if np.isfinite(speed) else np.inf)
        return bounded

    drifted = 0.0
    for _ in range(round(1 / TIME_STEP)):
        if not step():
            break
        drifted = max(drifted, abs(stage.position(joint.name)) / abs(far))
    point = grip_point(link, model.pieces[link.name], model.handles)
    reach = _lever(link, point)
    steps = round((2 * abs(far) * reach / HAND_SPEED + 1) / TIME_STEP)
    reached = []
    for way, goal in ((np.sign(far), OPEN), (-np.sign(far), 0.0)):
        for _ in range(steps):
            share = stage.position(joint.name) / far
            if not bounded or (share >= goal + 0.05 if goal else share <= 0.005):
                break
            _pull(stage, link, point, way, reach)
            step()
        reached.append(stage.position(joint.name) / far)
    return JointReport(reached[0], reached[1], drifted, fastest, bounded)


def grip_point(link: Link, pieces: Sequence[Array], handles: Mapping[str, Handle]) -> Array:
    """Where to pull a moving part (3,).

    Its first handle, or else its centre of mass (of a drawer) or the point farthest from the hinge (of a door).
    """
    for name in sorted(handles):
        if handles[name].link == link.name:
            return np.asarray(handles[name].position, float)
    if link.joint.kind == "prismatic":
        return np.asarray(link.center_of_mass, float)
    corners = np.concatenate(list(pieces))
    return corners[np.argmax([_lever(link, corner) for corner in corners])]


def _lever(link: Link, point: Array) -> float:
    """Metres that a point moves for a unit of the joint's motion."""
    if link.joint.kind == "prismatic":
        return 1.0
    return float(np.linalg.norm(np.cross(link.joint.axis, point - np.asarray(link.joint.origin))))


def _pull(stage: _Stage, link: Link, point: Array, way: float, reach: float) -> None:
    """Push with the hand for one step along the way the point can move."""
    pose = stage.matrix(link.name)
    axis, place = pose[:3, :3] @ link.joint.axis, pose[:3, :3] @ point + pose[:3, 3]
    if link.joint.kind == "revolute":
        axis = np.cross(axis, place - (pose[:3, :3] @ link.joint.origin + pose[:3, 3])) / reach
    speed = way * stage.speed(link.joint.name) * reach
    # a light part would be thrown about by the full force within a step
    force = min(FORCE, 0.5 * link.mass * HAND_SPEED / TIME_STEP) * np.clip(1 - speed / HAND_SPEED, -1, 1)
    stage.links[link.name].add_force_at_point((way * force * axis).astype(np.float32), place.astype(np.float32))


def _try_surface(model: _Model, surface: Surface) -> SurfaceReport:
    """Put things down with everything closed and, on a moving part, with it open as well."""
    states: list[dict[str, float]] = [{}]
    for link in model.links:
        level = link.joint.kind == "prismatic" or abs(link.joint.axis[2]) > 1 - 1e-6
        if link.name == surface.link and level:
            states.append({link.joint.name: OPEN * max(link.joint.limits, key=abs)})
    things = probes(surface)
    closed = [piece for pieces in model.pieces.values() for piece in pieces]
    spots = np.array([(*thing.xy, surface.z + BLOCKED) for thing in things]).reshape(-1, 3)
    room = float(clearances(closed, spots)[1].min() + BLOCKED) if things else 0.0
    moved = speed = 0.0
    for state in states:
        far, fast = _put_down(model, surface, things, state)
        moved, speed = max(moved, far), max(speed, fast)
    return SurfaceReport(len(things), moved, speed, room, room >= (surface.headroom or np.inf) - BLOCKED)


def _put_down(
    model: _Model, surface: Surface, things: Sequence[Probe], state: Mapping[str, float]
) -> tuple[float, float]:
    """The farthest that things moved on their surface in a second, m, and their greatest speed then, m/s."""
    stage = _Stage(model, state)
    start = link_poses(model.links, state)[surface.link] if surface.link else np.eye(4)
    bodies = []
    for thing in things:
        body = physx.PhysxRigidDynamicComponent()
        shape = cook(thing.corners, stage.material)
        shape.density = PROBE_DENSITY
        body.attach(shape)
        pose = start.copy()
        pose[:3, 3] = start[:3, :3] @ (*thing.xy, surface.z + 0.0005) + start[:3, 3]
        add_component(stage.scene, body, sapien.Pose(pose))
        bodies.append((body, np.linalg.inv(start) @ pose))
    for _ in range(round(1 / TIME_STEP)):
        stage.scene.step()
    now = np.linalg.inv(stage.matrix(surface.link))
    moved = speed = 0.0
    for thing, (body, before) in zip(things, bodies, strict=True):
        after = now @ pose_matrix(body)
        ends = np.concatenate([thing.corners, np.ones((len(thing.corners), 1))], axis=1)
        step = np.linalg.norm((ends @ (after - before).T)[:, :3], axis=1).max()
        moved = max(moved, float(step) if np.isfinite(step) else np.inf)
        speed = max(speed, float(np.linalg.norm(body.linear_velocity)))
    return moved, speed
