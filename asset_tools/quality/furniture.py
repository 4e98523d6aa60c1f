"""Test furniture in PhysX: open and close joints, and place objects on surfaces."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import sapien
from sapien import physx

from asset_tools.quality.furniture_scene import FurnitureModel, FurnitureScene, make_furniture_model
from asset_tools.quality.overlap import compute_distances, compute_max_overlap, make_convex_body
from asset_tools.quality.surfaces import BLOCKED, Probe, make_probes, measure_clearances
from asset_tools.sources import FurnitureSource
from robocas_ms3.assets.hulls import make_convex_mesh
from robocas_ms3.assets.kinematics import link_poses
from robocas_ms3.assets.manifest import FurnitureQuality, Handle, Link, Surface
from robocas_ms3.assets.pack import LoadedFurniture
from robocas_ms3.assets.physics import TIME_STEP, add_component, engine_settings, make_shape, pose_matrix

Array = np.ndarray

FORCE = 30.0  # N at the handle, about the limit of the arm
HAND_SPEED = 0.25  # m/s; the force decreases to 0 at this speed of the handle
OPEN, CLOSED = 0.9, 0.05  # fractions of the range
STILL = 0.01  # fraction of the range that a part may move in 1 s without force
FASTEST = {"prismatic": 2.0, "revolute": 10.0}  # m/s, rad/s; higher speeds cannot be caused by the hand
JAMMED = 0.002  # m, largest overlap of a moving part with others
STOPS = (0.0, 0.02, 0.05, 0.2, 0.4, 0.6, 0.8, 1.0)  # fractions of the range at which the overlap is checked
GRIP = 0.005  # m, largest distance of a handle's TCP from its part
OPENING = 0.08  # m between the open fingers
SLID, OFF, SPEED = 0.01, 0.002, 0.01  # m along and off the surface, m/s; limits for a placed object
PROBE_DENSITY = 500.0  # kg/m3


@dataclass(frozen=True)
class JointReport:
    """Results of the test of a joint: wait, open and close with a pulling force.

    Positions are fractions of the range of the joint; 0 is closed.

    Attributes:
        opened: position after opening.
        closed: position after closing.
        drifted: largest position within 1 s without force, before opening.
        fastest: largest speed of any joint during the test, m/s or rad/s; infinite for NaN.
        bounded: whether no speed was larger than a pulling hand can cause.
        overlap: largest overlap of the moving part with other parts at any position of the joint, m. This is computed,
            since PhysX ignores contacts between a link and its parent and would let a drawer slide through a wall.
        grip: largest distance of a handle's grasp from the moving part, m; 0 without handles; infinite if the open
            fingers would collide.
    """

    opened: float
    closed: float
    drifted: float
    fastest: float
    bounded: bool
    overlap: float
    grip: float

    @property
    def works(self) -> bool:
        """Whether the joint opens, closes and stays closed, without overlaps and with usable handles."""
        moves = self.bounded and self.opened >= OPEN and abs(self.closed) <= CLOSED and self.drifted <= STILL
        return moves and self.overlap <= JAMMED and self.grip <= GRIP


@dataclass(frozen=True)
class SurfaceReport:
    """Results of the test of a surface: objects are placed on it and simulated for 1 s.

    Attributes:
        probes: number of placed objects.
        slid: largest motion of an object along the surface in 1 s, m.
        off: largest vertical motion of an object in 1 s, m.
        speed: largest speed of an object after 1 s, m/s.
        headroom: smallest free height above the surface, m; infinite if nothing is above the surface.
        enough: whether the free height is at least the headroom that the manifest declares.
    """

    probes: int
    slid: float
    off: float
    speed: float
    headroom: float
    enough: bool

    @property
    def holds(self) -> bool:
        """Whether objects stay at rest on the surface, and the declared headroom is free."""
        stays = self.slid < SLID and self.off <= OFF and self.speed < SPEED
        return self.probes > 0 and stays and self.enough


@dataclass(frozen=True)
class FurnitureReport:
    """Results of the tests of a piece of furniture: name of a joint or surface -> results."""

    joints: dict[str, JointReport]
    surfaces: dict[str, SurfaceReport]


def measure_furniture(furniture: FurnitureSource | LoadedFurniture) -> FurnitureQuality:
    """Measure the quality of furniture: hull counts and fractions of working joints and surfaces.

    The result is deterministic.

    Raises:
        AssetError: the physics engine rejects a hull.
    """
    report = examine_furniture(furniture)
    hulls = [piece for pieces in make_furniture_model(furniture).pieces.values() for piece in pieces]
    return FurnitureQuality(
        hull_count=len(hulls),
        hull_vertices=max(len(make_convex_mesh(hull)[0]) for hull in hulls),
        joints_open=_true_fraction(joint.works for joint in report.joints.values()),
        surfaces_hold=_true_fraction(surface.holds for surface in report.surfaces.values()),
    )


def examine_furniture(furniture: FurnitureSource | LoadedFurniture) -> FurnitureReport:
    """Test each joint and each surface of furniture in PhysX; deterministic.

    Raises:
        AssetError: the physics engine rejects a hull.
    """
    model = make_furniture_model(furniture)
    with engine_settings():
        joints = {link.joint.name: _try_joint(model, link) for link in model.links}
        return FurnitureReport(joints, {name: _try_surface(model, surface) for name, surface in model.surfaces.items()})


def _true_fraction(flags: Iterable[bool]) -> float | None:
    found = list(flags)
    return sum(found) / len(found) if found else None


def _try_joint(model: FurnitureModel, link: Link) -> JointReport:
    joint, stage = link.joint, FurnitureScene(model)
    far = max(joint.limits, key=abs)
    fastest, bounded = 0.0, True

    def step() -> bool:
        nonlocal fastest, bounded
        stage.scene.step()
        for other in model.links:
            speed = abs(stage.get_joint_speed(other.joint.name))
            if not np.isfinite(speed) or speed > FASTEST[other.joint.kind]:
                bounded = False
            fastest = max(fastest, speed if np.isfinite(speed) else np.inf)
        return bounded

    drifted = 0.0
    for _ in range(round(1 / TIME_STEP)):
        if not step():
            break
        drifted = max(drifted, abs(stage.get_joint_position(joint.name)) / abs(far))
    point = find_grip_point(link, model.pieces[link.name], model.handles)
    reach = _lever(link, point)
    steps = round((2 * abs(far) * reach / HAND_SPEED + 1) / TIME_STEP)
    reached = []
    for way, goal in ((np.sign(far), OPEN), (-np.sign(far), 0.0)):
        for _ in range(steps):
            share = stage.get_joint_position(joint.name) / far
            if not bounded or (share >= goal + 0.05 if goal else share <= 0.005):
                break
            _pull(stage, link, point, way, reach)
            step()
        reached.append(stage.get_joint_position(joint.name) / far)
    return JointReport(reached[0], reached[1], drifted, fastest, bounded, _jam(model, link), _grip(model, link))


def _jam(model: FurnitureModel, link: Link) -> float:
    """Return the largest overlap in m of a moving part with the rest, at any position of its joint.

    Links that are attached to the part move with it. All other joints are closed.
    """
    carried = {link.name}
    for other in model.links:
        if other.parent in carried:
            carried.add(other.name)
    moving = [make_convex_body(piece) for name in model.pieces if name in carried for piece in model.pieces[name]]
    rest = [make_convex_body(piece) for name in model.pieces if name not in carried for piece in model.pieces[name]]
    low, high = link.joint.limits
    found = 0.0
    for share in (*STOPS, -low / (high - low)):
        pose = link_poses(model.links, {link.joint.name: low + share * (high - low)})[link.name]
        found = max(found, compute_max_overlap([body.transform(pose) for body in moving], rest))
    return found


def _grip(model: FurnitureModel, link: Link) -> float:
    """Return the largest distance in m of a handle's grasp from the moving part.

    The result is infinite if a finger would collide.

    Without handles, the result is 0.
    """
    worst = 0.0
    everything = [piece for pieces in model.pieces.values() for piece in pieces]
    for handle in model.handles.values():
        if handle.link != link.name:
            continue
        tcp = np.array(handle.position)
        fingers = tcp + OPENING / 2 * np.outer((-1, 1), sapien.Pose(q=handle.wxyz).to_transformation_matrix()[:3, 1])
        worst = max(worst, float(compute_distances(model.pieces[link.name], tcp[None])[0]))
        if (compute_distances(everything, fingers) <= 0).any():
            worst = np.inf
    return worst


def find_grip_point(link: Link, pieces: Sequence[Array], handles: Mapping[str, Handle]) -> Array:
    """Return the point (3,) at which the test pulls a moving part, in the furniture's frame, m.

    The point is the first handle of the part. Without a handle, the point is the centre of mass of a drawer, or the
    corner of a door farthest from the hinge.
    """
    for name in sorted(handles):
        if handles[name].link == link.name:
            return np.asarray(handles[name].position, float)
    if link.joint.kind == "prismatic":
        return np.asarray(link.center_of_mass, float)
    corners = np.concatenate(list(pieces))
    return corners[np.argmax([_lever(link, corner) for corner in corners])]


def _lever(link: Link, point: Array) -> float:
    """Return by how many metres a point (3,) of a moving part moves per m or rad of the joint's position."""
    if link.joint.kind == "prismatic":
        return 1.0
    return float(np.linalg.norm(np.cross(link.joint.axis, point - np.asarray(link.joint.origin))))


def _pull(stage: FurnitureScene, link: Link, point: Array, way: float, reach: float) -> None:
    """Apply a pulling force to a moving part for one simulation step, along the motion of the joint.

    Args:
        stage: scene with the furniture.
        link: the moving part.
        point: (3,) point of the part at which the force acts, in the furniture's frame with closed joints, m.
        way: 1 to increase the position of the joint, -1 to decrease it.
        reach: motion of the point in m per m or rad of the joint's position.
    """
    pose = stage.get_link_pose(link.name)
    axis, place = pose[:3, :3] @ link.joint.axis, pose[:3, :3] @ point + pose[:3, 3]
    if link.joint.kind == "revolute":
        axis = np.cross(axis, place - (pose[:3, :3] @ link.joint.origin + pose[:3, 3])) / reach
    speed = way * stage.get_joint_speed(link.joint.name) * reach
    # the full force would accelerate a light part too much within a step
    force = min(FORCE, 0.5 * link.mass * HAND_SPEED / TIME_STEP) * np.clip(1 - speed / HAND_SPEED, -1, 1)
    stage.links[link.name].add_force_at_point((way * force * axis).tolist(), place.tolist())


def _try_surface(model: FurnitureModel, surface: Surface) -> SurfaceReport:
    """Test a surface with all joints closed.

    If the surface moves and stays level, the test is repeated with its part open.
    """
    states: list[dict[str, float]] = [{}]
    for link in model.links:
        level = link.joint.kind == "prismatic" or abs(link.joint.axis[2]) > 1 - 1e-6
        if link.name == surface.link and level:
            states.append({link.joint.name: OPEN * max(link.joint.limits, key=abs)})
    things = make_probes(surface)
    closed = [piece for pieces in model.pieces.values() for piece in pieces]
    spots = np.array([(*thing.xy, surface.z + BLOCKED) for thing in things]).reshape(-1, 3)
    room = float(measure_clearances(closed, spots)[1].min() + BLOCKED) if things else 0.0
    found = np.max([_put_down(model, surface, things, state) for state in states], axis=0)
    slid, off, speed = (float(value) for value in found)
    return SurfaceReport(len(things), slid, off, speed, room, room >= (surface.headroom or np.inf) - OFF)


def _put_down(
    model: FurnitureModel, surface: Surface, things: Sequence[Probe], state: Mapping[str, float]
) -> tuple[float, float, float]:
    """Place probe objects on a surface and simulate them for 1 s.

    Args:
        model: the furniture.
        surface: the surface.
        things: the probe objects.
        state: name of a joint -> position; other joints are closed.

    Returns:
        Over all objects, the largest motion along the surface in m, the largest vertical motion in m, and the largest
        speed at the end in m/s.
    """
    stage = FurnitureScene(model, state)
    start = link_poses(model.links, state)[surface.link] if surface.link else np.eye(4)
    bodies = []
    for thing in things:
        body = physx.PhysxRigidDynamicComponent()
        shape = make_shape(thing.corners, stage.material)
        shape.density = PROBE_DENSITY
        body.attach(shape)
        pose = start.copy()
        pose[:3, 3] = start[:3, :3] @ (*thing.xy, surface.z + 0.0005) + start[:3, 3]
        add_component(stage.scene, body, sapien.Pose(pose))
        pose[:3, 3] = start[:3, :3] @ (*thing.xy, surface.z) + start[:3, 3]
        bodies.append((body, np.linalg.inv(start) @ pose))
    for _ in range(round(1 / TIME_STEP)):
        stage.scene.step()
    now = np.linalg.inv(stage.get_link_pose(surface.link))
    slid, off, speed = [0.0], [0.0], [0.0]
    for thing, (body, before) in zip(things, bodies, strict=True):
        after = now @ pose_matrix(body)
        ends = np.concatenate([thing.corners, np.ones((len(thing.corners), 1))], axis=1)
        steps = np.nan_to_num(ends @ (after - before).T, nan=np.inf, posinf=np.inf, neginf=np.inf)
        slid.append(float(np.linalg.norm(steps[:, :2], axis=1).max()))
        off.append(float(np.abs(steps[:, 2]).max()))
        speed.append(float(np.linalg.norm(body.linear_velocity)))
    return max(slid), max(off), max(speed)
