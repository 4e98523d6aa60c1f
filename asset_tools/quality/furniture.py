"""Test furniture in the physics engine: opening and closing of joints, and objects on surfaces."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import sapien
from sapien import physx

from asset_tools.quality.furniture_scene import FurnitureModel, FurnitureScene, make_model
from asset_tools.quality.overlap import distances, make_convex_body, max_overlap
from asset_tools.quality.surfaces import BLOCKED, Probe, clearances, make_probes
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
    """Response of a joint to a force; positions are fractions of its range.

    Attributes:
        opened: position after opening.
        closed: position after closing.
        drifted: largest motion within 1 s without force, closed.
        fastest: largest speed of any joint during the test, m/s or rad/s; infinite for NaN.
        bounded: whether all speeds could be caused by the hand.
        overlap: largest overlap with parts that do not move with it, over the whole range, m. The engine ignores
            contacts between a link and its parent, so that a drawer could slide through a wall.
        grip: largest distance of a handle from its part, m; 0 without handles; infinite if the open fingers would
            collide.
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
        """Whether the joint opens, closes and stays still, without overlaps and with reachable handles."""
        moves = self.bounded and self.opened >= OPEN and abs(self.closed) <= CLOSED and self.drifted <= STILL
        return moves and self.overlap <= JAMMED and self.grip <= GRIP


@dataclass(frozen=True)
class SurfaceReport:
    """Results of placing objects on a surface.

    Attributes:
        probes: number of placed objects.
        slid: largest motion along the surface in 1 s, m.
        off: largest distance from the surface's height after 1 s, m.
        speed: largest speed after 1 s, m/s.
        headroom: smallest free height above the surface, m; infinite if nothing is above it.
        enough: whether the headroom is at least the declared one.
    """

    probes: int
    slid: float
    off: float
    speed: float
    headroom: float
    enough: bool

    @property
    def holds(self) -> bool:
        """Whether objects stay on the surface, and the declared headroom is free."""
        stays = self.slid < SLID and self.off <= OFF and self.speed < SPEED
        return self.probes > 0 and stays and self.enough


@dataclass(frozen=True)
class FurnitureReport:
    """Results for each joint and surface, by name."""

    joints: dict[str, JointReport]
    surfaces: dict[str, SurfaceReport]


def measure_furniture(furniture: FurnitureSource | LoadedFurniture) -> FurnitureQuality:
    """Measure hull counts and the fractions of working joints and stable surfaces; deterministic.

    Raises:
        AssetError: the physics engine rejects a hull.
    """
    report = examine_furniture(furniture)
    hulls = [piece for pieces in make_model(furniture).pieces.values() for piece in pieces]
    return FurnitureQuality(
        hull_count=len(hulls),
        hull_vertices=max(len(make_convex_mesh(hull)[0]) for hull in hulls),
        joints_open=_true_fraction(joint.works for joint in report.joints.values()),
        surfaces_hold=_true_fraction(surface.holds for surface in report.surfaces.values()),
    )


def examine_furniture(furniture: FurnitureSource | LoadedFurniture) -> FurnitureReport:
    """Measure each joint and surface.

    Raises:
        AssetError: the physics engine rejects a hull.
    """
    model = make_model(furniture)
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
    return JointReport(reached[0], reached[1], drifted, fastest, bounded, _jam(model, link), _grip(model, link))


def _jam(model: FurnitureModel, link: Link) -> float:
    """Return the largest overlap in m of a part and the links it carries with the rest, other joints closed."""
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
        found = max(found, max_overlap([body.moved(pose) for body in moving], rest))
    return found


def _grip(model: FurnitureModel, link: Link) -> float:
    """Return the largest distance in m of a handle from its part; infinite if an open finger would collide."""
    worst = 0.0
    everything = [piece for pieces in model.pieces.values() for piece in pieces]
    for handle in model.handles.values():
        if handle.link != link.name:
            continue
        tcp = np.array(handle.position)
        fingers = tcp + OPENING / 2 * np.outer((-1, 1), sapien.Pose(q=handle.wxyz).to_transformation_matrix()[:3, 1])
        worst = max(worst, float(distances(model.pieces[link.name], tcp[None])[0]))
        if (distances(everything, fingers) <= 0).any():
            worst = np.inf
    return worst


def grip_point(link: Link, pieces: Sequence[Array], handles: Mapping[str, Handle]) -> Array:
    """Return the point (3,) at which a moving part is pulled.

    The point is the first handle, or else the centre of mass of a drawer or the point of a door farthest from the
    hinge.
    """
    for name in sorted(handles):
        if handles[name].link == link.name:
            return np.asarray(handles[name].position, float)
    if link.joint.kind == "prismatic":
        return np.asarray(link.center_of_mass, float)
    corners = np.concatenate(list(pieces))
    return corners[np.argmax([_lever(link, corner) for corner in corners])]


def _lever(link: Link, point: Array) -> float:
    """Return the motion of a point in m per unit of the joint's position."""
    if link.joint.kind == "prismatic":
        return 1.0
    return float(np.linalg.norm(np.cross(link.joint.axis, point - np.asarray(link.joint.origin))))


def _pull(stage: FurnitureScene, link: Link, point: Array, way: float, reach: float) -> None:
    """Apply the hand's force for one step along the possible motion of the point."""
    pose = stage.matrix(link.name)
    axis, place = pose[:3, :3] @ link.joint.axis, pose[:3, :3] @ point + pose[:3, 3]
    if link.joint.kind == "revolute":
        axis = np.cross(axis, place - (pose[:3, :3] @ link.joint.origin + pose[:3, 3])) / reach
    speed = way * stage.speed(link.joint.name) * reach
    # the full force would accelerate a light part too much within a step
    force = min(FORCE, 0.5 * link.mass * HAND_SPEED / TIME_STEP) * np.clip(1 - speed / HAND_SPEED, -1, 1)
    stage.links[link.name].add_force_at_point((way * force * axis).tolist(), place.tolist())


def _try_surface(model: FurnitureModel, surface: Surface) -> SurfaceReport:
    """Place objects with all joints closed and, for a surface of a moving part, also with this part open."""
    states: list[dict[str, float]] = [{}]
    for link in model.links:
        level = link.joint.kind == "prismatic" or abs(link.joint.axis[2]) > 1 - 1e-6
        if link.name == surface.link and level:
            states.append({link.joint.name: OPEN * max(link.joint.limits, key=abs)})
    things = make_probes(surface)
    closed = [piece for pieces in model.pieces.values() for piece in pieces]
    spots = np.array([(*thing.xy, surface.z + BLOCKED) for thing in things]).reshape(-1, 3)
    room = float(clearances(closed, spots)[1].min() + BLOCKED) if things else 0.0
    found = np.max([_put_down(model, surface, things, state) for state in states], axis=0)
    slid, off, speed = (float(value) for value in found)
    return SurfaceReport(len(things), slid, off, speed, room, room >= (surface.headroom or np.inf) - OFF)


def _put_down(
    model: FurnitureModel, surface: Surface, things: Sequence[Probe], state: Mapping[str, float]
) -> tuple[float, float, float]:
    """Return largest motion along the surface in 1 s and distance from its height in m, and largest speed in m/s."""
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
    now = np.linalg.inv(stage.matrix(surface.link))
    slid, off, speed = [0.0], [0.0], [0.0]
    for thing, (body, before) in zip(things, bodies, strict=True):
        after = now @ pose_matrix(body)
        ends = np.concatenate([thing.corners, np.ones((len(thing.corners), 1))], axis=1)
        steps = np.nan_to_num(ends @ (after - before).T, nan=np.inf, posinf=np.inf, neginf=np.inf)
        slid.append(float(np.linalg.norm(steps[:, :2], axis=1).max()))
        off.append(float(np.abs(steps[:, 2]).max()))
        speed.append(float(np.linalg.norm(body.linear_velocity)))
    return max(slid), max(off), max(speed)
