"""Furniture in the physics engine: whether its parts open and close, and things stay on it."""

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
from robocas_ms3.assets.hulls import convex_faces
from robocas_ms3.assets.kinematics import link_poses
from robocas_ms3.assets.manifest import FurnitureQuality, Handle, Link, Surface
from robocas_ms3.assets.pack import LoadedFurniture
from robocas_ms3.assets.physics import TIME_STEP, add_component, engine_settings, make_shape, pose_matrix

Array = np.ndarray

FORCE = 30.0  # N at the handle, about what the arm can do
HAND_SPEED = 0.25  # m/s: the hand pushes less the nearer the handle comes to it
OPEN, CLOSED = 0.9, 0.05  # shares of the range
STILL = 0.01  # share of the range that a part left alone may move in a second
FASTEST = {"prismatic": 2.0, "revolute": 10.0}  # m/s, rad/s: nothing a hand of this speed could cause
JAMMED = 0.002  # m that a moving part may reach into others
STOPS = (0.0, 0.02, 0.05, 0.2, 0.4, 0.6, 0.8, 1.0)  # shares of the range where that is looked at
GRIP = 0.005  # m from a handle's TCP to what it should hold
OPENING = 0.08  # m between the open fingers
SLID, OFF, SPEED = 0.01, 0.002, 0.01  # m along the surface and off its height, m/s: what a thing put down may do
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
        overlap: how deep it reaches into what doesn't move with it, anywhere on its way, m. The engine doesn't see
            that: it ignores contacts between a link and its parent, so a drawer slides through solid wood.
        grip: how far the worst of its handles is from the part it should take hold of, m; 0 without handles, infinite
            where there is no room for the open fingers beside it.
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
        """Whether it opens, closes and stays still, has room to, and can be taken hold of."""
        moves = self.bounded and self.opened >= OPEN and abs(self.closed) <= CLOSED and self.drifted <= STILL
        return moves and self.overlap <= JAMMED and self.grip <= GRIP


@dataclass(frozen=True)
class SurfaceReport:
    """What became of things put on a surface.

    Attributes:
        probes: how many were put there.
        slid: the farthest that one of them moved along the surface in a second, m.
        off: the most that one of them then stood above or below the surface's height, m.
        speed: of the fastest at the end, m/s.
        headroom: the least free height found above it, m; infinite under the open sky.
        enough: whether that is what the surface says.
    """

    probes: int
    slid: float
    off: float
    speed: float
    headroom: float
    enough: bool

    @property
    def holds(self) -> bool:
        """Whether things stay on it, and there is as much room above it as it says."""
        stays = self.slid < SLID and self.off <= OFF and self.speed < SPEED
        return self.probes > 0 and stays and self.enough


@dataclass(frozen=True)
class FurnitureReport:
    """What was measured of each joint and surface, by name."""

    joints: dict[str, JointReport]
    surfaces: dict[str, SurfaceReport]


def measure_furniture(furniture: FurnitureSource | LoadedFurniture) -> FurnitureQuality:
    """Return the shares of joints that work and surfaces that hold. The same furniture gives the same figures.

    Raises:
        AssetError: the physics engine refuses a hull.
    """
    report = examine_furniture(furniture)
    hulls = [piece for pieces in make_model(furniture).pieces.values() for piece in pieces]
    return FurnitureQuality(
        hull_count=len(hulls),
        hull_vertices=max(len(convex_faces(hull)[0]) for hull in hulls),
        joints_open=_share(joint.works for joint in report.joints.values()),
        surfaces_hold=_share(surface.holds for surface in report.surfaces.values()),
    )


def examine_furniture(furniture: FurnitureSource | LoadedFurniture) -> FurnitureReport:
    """Measure each joint and surface.

    Raises:
        AssetError: the physics engine refuses a hull.
    """
    model = make_model(furniture)
    with engine_settings():
        joints = {link.joint.name: _try_joint(model, link) for link in model.links}
        return FurnitureReport(joints, {name: _try_surface(model, surface) for name, surface in model.surfaces.items()})


def _share(flags: Iterable[bool]) -> float | None:
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
    """How deep a part, with all that hangs on it, reaches into the rest, the other joints closed, m."""
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
    """How far the worst handle is from its part, m; infinite where an open finger would stand in something."""
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


def _pull(stage: FurnitureScene, link: Link, point: Array, way: float, reach: float) -> None:
    """Push with the hand for one step along the way the point can move."""
    pose = stage.matrix(link.name)
    axis, place = pose[:3, :3] @ link.joint.axis, pose[:3, :3] @ point + pose[:3, 3]
    if link.joint.kind == "revolute":
        axis = np.cross(axis, place - (pose[:3, :3] @ link.joint.origin + pose[:3, 3])) / reach
    speed = way * stage.speed(link.joint.name) * reach
    # a light part would be thrown about by the full force within a step
    force = min(FORCE, 0.5 * link.mass * HAND_SPEED / TIME_STEP) * np.clip(1 - speed / HAND_SPEED, -1, 1)
    stage.links[link.name].add_force_at_point((way * force * axis).tolist(), place.tolist())


def _try_surface(model: FurnitureModel, surface: Surface) -> SurfaceReport:
    """Put things down with everything closed and, on a moving part, with it open as well."""
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
    """The farthest that things moved along their surface in a second and then were off its height, m; their speed."""
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
