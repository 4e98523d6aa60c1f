"""Decisions of `keyframe` in a scene without a simulator: an arm that reaches every commanded pose."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation
from synthetic_observations import observe, start

from robocas_ms3.baselines.keyframe import KeyframeConfig, KeyframeNetwork, KeyframePolicy
from robocas_ms3.baselines.keyframe.arm_control import CLOSED, OPEN, ArmControl, EpisodeObservation
from robocas_ms3.baselines.keyframe.episode import KeyframeEpisode
from robocas_ms3.baselines.keyframe.grasp_proposals import compute_similarity
from robocas_ms3.baselines.keyframe.handles import Handle
from robocas_ms3.baselines.keyframe.motion import ArmPaths
from robocas_ms3.baselines.keyframe.observed_scene import ObservedObject, ObservedScene
from robocas_ms3.baselines.keyframe.perception import CameraFrame, Request, Survey
from robocas_ms3.core.errors import RobocasError
from robocas_ms3.core.poses import from_rotation, to_wxyz
from robocas_ms3.robots.description import MOBILE_PANDA
from robocas_ms3.robots.registry import DEFAULT_ROBOT, PANDA, ROBOTS, find_robot

REST = np.array([0, np.pi / 8, 0, -5 * np.pi / 8, 0, 3 * np.pi / 4, np.pi / 4])
TABLE, BASKET = 0.1, np.array([0.5, 0.5, 0.25])
SIZE = (64, 64)
CONFIG = KeyframeConfig(image_size=SIZE, crop_size=SIZE, channels=(8, 8, 8, 8, 8), decoder_channels=8)
CAMERAS = ("base_camera", "gripper_camera")
FACTS = {"names": ["apple", "box"], "cameras": list(CAMERAS), "hand_camera": "gripper_camera"}


def make_block(center, size=(0.04, 0.04, 0.04), count=600):
    """Points on the visible sides of a box on the table."""
    rng = np.random.default_rng(int(1000 * center[0]))
    points = rng.uniform(-0.5, 0.5, (count, 3))
    points[: count // 2, 2] = 0.5
    points[count // 2 :, 0] = np.where(rng.random(count - count // 2) < 0.5, -0.5, 0.5)
    return points * size + [*center, TABLE + size[2] / 2]


class FakePerception:
    """Perception that sees the present blocks and the table, or a closed door with a handle before them.

    Blocks named "late" are visible from the second view on. The basket is visible from the survey ``basket_from`` on.
    """

    def __init__(self, blocks, door=None, basket_from=1, *, has_objects=False):
        self.blocks, self.door, self.surveys, self.views, self.basket_from = blocks, door, 0, 0, basket_from
        self.has_objects = has_objects

    def survey(self, frames, default_table):
        self.surveys += 1
        handle = None if self.door is None or self.door.opening > 0.9 else self.door.handle
        basket = BASKET if self.surveys >= self.basket_from else None
        has_roof, focus = self.door is not None, np.array([0.55, 0.0])
        return Survey(focus, basket, TABLE, np.zeros((0, 3)), handle, self.has_objects, has_roof)

    def observe(self, frame, request, table):
        x, y = np.meshgrid(np.arange(0.3, 0.8, 0.01), np.arange(-0.4, 0.3, 0.01))
        surface = np.stack([x.ravel(), y.ravel(), np.full(x.size, TABLE)], axis=1)
        self.views += 1
        seen = {name: center for name, center in self.blocks.items() if self.views > 1 or "late" not in name}
        sizes = [(0.04, 0.04, 0.25 if "tall" in name else 0.04) for name in seen]
        clouds = [make_block(center, size) for center, size in zip(seen.values(), sizes, strict=True)]
        points = np.concatenate([surface, *clouds])
        bounds = len(surface) + np.cumsum([0, *map(len, clouds)])
        objects = []
        for number, (name, center) in enumerate(seen.items()):
            mask = np.zeros(len(points), dtype=bool)
            mask[bounds[number] : bounds[number + 1]] = True
            middle = np.array([*center, TABLE + sizes[number][2] / 2])
            objects.append((name, ObservedObject(mask, middle, 0, 0.9)))
        targets = [one for name, one in objects if name.startswith("target")]
        is_object = np.arange(len(points)) >= len(surface)
        return ObservedScene(points, is_object, targets, [one for _, one in objects])

    def score_grasps(self, scene, mask, grasps, table):
        return np.full(len(grasps), 0.9)


class FakeArm:
    """Arm that reaches each commanded pose exactly and grasps a block or handle that is between the closed fingers.

    The first ``slips`` grasps of blocks fail. The first ``stops`` motions to blocked positions are not executed
    (``is_blocked(position, name of the held block or None)``).
    """

    def __init__(self, paths, blocks, door=None, slips=0, stops=0, is_blocked=lambda at, held: held and at[1] > 0.15):
        self.slips, self.stops, self.is_blocked, self.grasps = slips, stops, is_blocked, []
        self.trace: list[tuple[np.ndarray, float]] = []  # TCP pose and gripper command of each step
        self.paths, self.blocks, self.qpos, self.held, self.door = paths, blocks, REST, None, door
        self.released: list[tuple[str, np.ndarray]] = []
        self.is_closed = False

    @property
    def tcp(self):
        return self.paths.chain.tcp(self.qpos[None])[0]

    def view(self, images=False):
        frame = CameraFrame(np.zeros((64, 64, 3), np.uint8), np.zeros((64, 64)), np.eye(3), self.tcp)
        width = 0.04 if self.held else 0.0 if self.is_closed else 0.08
        return EpisodeObservation(self.tcp, self.qpos, width, {"gripper_camera": frame} if images else {})

    def step(self, command):
        motion = from_rotation(command.action[:3], Rotation.from_euler("xyz", command.action[3:6]).as_matrix())
        assert np.abs(command.action[:3]).max() <= 0.1
        goal = self.tcp @ motion
        reachable, found = self.paths.reach(goal[None], self.qpos)
        assert reachable[0]
        self.trace.append((self.tcp, command.action[6]))
        is_stuck = self.door is not None and self.door.is_stuck(goal[:3, 3], command.action[6] == CLOSED)
        if is_stuck or (self.stops and self.is_blocked(goal[:3, 3], self.held)):
            self.stops -= 1
        else:
            self.qpos = found[0]
        position = self.tcp[:3, 3]
        if command.action[6] == CLOSED and self.held is None:
            near = [name for name, center in self.blocks.items() if np.linalg.norm(center - position[:2]) < 0.03]
            low = TABLE + (0.27 if near and "tall" in near[0] else 0.06)
            if near and position[2] < low and not self.is_closed:
                self.grasps.append(self.tcp)
                if len(self.grasps) > self.slips:
                    self.held = near[0]
                    del self.blocks[near[0]]
        if self.door is not None:
            self.door.follow(position, command.action[6] == CLOSED)
        if command.action[6] == OPEN and self.held is not None:
            self.released.append((self.held, position))
            self.held = None
        self.is_closed = command.action[6] == CLOSED
        return self.view(command.requests_images)


class FakeDoor:
    """Door that follows a closed gripper at its handle, up to an end stop."""

    def __init__(self, end=1.0):
        self.end = end
        ends = np.array([0.45, -0.27, 0.2]), np.array([0.0, 0.4, 0.0])
        self.handle = Handle(*ends, np.array([1.0, 0, 0]), np.array([0, 0, 1.0]))
        self.opening, self.is_held = 0.0, False

    def is_stuck(self, position, closed):
        """Return whether the gripper would pull the door beyond its end stop."""
        opening = (position - self.handle.position) @ self.handle.motion / 0.4**2
        return closed and self.is_held and opening > self.end + 1e-6

    def follow(self, position, closed):
        here = self.handle.position + self.opening * self.handle.motion
        self.is_held = closed and (self.is_held or np.linalg.norm(position - here) < 0.01)
        if self.is_held:
            self.opening = float((position - self.handle.position) @ self.handle.motion / 0.4**2)


@pytest.fixture(scope="module")
def paths():
    return ArmPaths(find_robot(DEFAULT_ROBOT))


def play(paths, blocks, request=None, steps=150, door=None, basket_from=1, **arm_options):
    arm = FakeArm(paths, blocks, door, **arm_options)
    request = request or Request(np.ones(1, np.float32), None)
    rng = np.random.default_rng(0)
    perception = FakePerception(blocks, door, basket_from)
    control = ArmControl(paths, 1)
    episode = KeyframeEpisode(perception, control, CONFIG.decisions, request, rng, "gripper_camera")
    run = episode.run(arm.view(images=True))
    command = next(run)
    for _ in range(steps):
        command = run.send(arm.step(command))
        if arm.released:
            break
    return arm


def test_the_target_is_released_over_the_basket(paths):
    arm = play(paths, {"target": np.array([0.55, -0.1])})
    (name, position), *_ = arm.released
    assert name == "target" and np.linalg.norm(position[:2] - BASKET[:2]) < 0.06 and position[2] > BASKET[2]


def test_the_nearest_target_is_meant_without_a_relation(paths):
    blocks = {"target far": np.array([0.65, 0.0]), "target near": np.array([0.45, -0.1])}
    assert play(paths, dict(blocks)).released[0][0] == "target near"
    far = Request(np.ones(1, np.float32), "farthest")
    assert play(paths, dict(blocks), far).released[0][0] == "target far"


def test_a_tall_object_is_carried_above_the_rim(paths):
    arm = play(paths, {"target tall": np.array([0.55, -0.1])})
    (name, position), *_ = arm.released
    below_tcp = arm.grasps[0][2, 3] - TABLE  # the object stands on the table
    assert name == "target tall" and below_tcp > 0.15 and position[2] - below_tcp > BASKET[2]


def test_a_failed_grasp_is_not_repeated(paths):
    arm = play(paths, {"target": np.array([0.55, -0.1])}, slips=4, steps=300)
    assert arm.released[0][0] == "target" and len(arm.grasps) == 5
    for number, grasp in enumerate(arm.grasps):
        assert (compute_similarity(np.stack(arm.grasps[number + 1 :] or [np.eye(4)]), grasp) < 0.7).all()


def test_the_target_of_a_relation_stays_the_same(paths):
    blocks = {
        "target far": np.array([0.68, 0.0]),
        "target near": np.array([0.58, -0.1]),
        "target late": np.array([0.48, 0.0]),
    }
    arm = play(paths, blocks, Request(np.ones(1, np.float32), "nearest"), slips=1)
    assert arm.released[0][0] == "target near"


def test_the_basket_is_searched_until_it_is_seen(paths):
    arm = play(paths, {"target": np.array([0.55, -0.1])}, basket_from=2)
    (name, position), *_ = arm.released
    assert name == "target" and np.linalg.norm(position[:2] - BASKET[:2]) < 0.06


def test_an_object_is_moved_aside_if_the_target_is_not_seen(paths):
    arm = play(paths, {"other": np.array([0.55, 0.0])})
    (name, position), *_ = arm.released
    assert name == "other" and np.linalg.norm(position[:2] - BASKET[:2]) > 0.2 and position[2] < TABLE + 0.1


def test_a_table_is_surveyed_once(paths):
    """Later images may show a part of the basket, or objects in it."""
    perception, arm = FakePerception({}), FakeArm(paths, {})
    request, rng = Request(np.ones(1, np.float32), None), np.random.default_rng(0)
    episode = KeyframeEpisode(perception, ArmControl(paths, 1), CONFIG.decisions, request, rng, "gripper_camera")
    run = episode.run(arm.view(images=True))
    command = next(run)
    for _ in range(60):
        command = run.send(arm.step(command))
    assert perception.surveys == 1


def test_the_door_is_opened_before_the_target_is_grasped(paths):
    door = FakeDoor()
    arm = play(paths, {"target": np.array([0.62, -0.1])}, door=door)
    assert door.opening > 0.95
    (name, position), *_ = arm.released
    assert name == "target" and np.linalg.norm(position[:2] - BASKET[:2]) < 0.06
    assert BASKET[2] < position[2] < BASKET[2] + 0.1  # lowered before the release


def test_an_arm_that_is_stopped_before_a_compartment_takes_another_way(paths):
    arm = play(paths, {"target": np.array([0.62, -0.1])}, door=FakeDoor(), stops=2, steps=300)
    (name, position), *_ = arm.released
    assert name == "target" and arm.stops == 0 and np.linalg.norm(position[:2] - BASKET[:2]) < 0.06


@pytest.mark.parametrize("is_front", [False, True])
def test_an_object_without_a_way_to_the_basket_is_put_back(paths, is_front):
    place = np.array([0.62, -0.1])
    arm = play(paths, {"target": place}, door=FakeDoor() if is_front else None, stops=1000, steps=300)
    (name, position), *_ = arm.released
    assert name == "target" and np.linalg.norm(position[:2] - place) < 0.03 and position[2] < TABLE + 0.08


def test_an_object_that_cannot_leave_the_compartment_is_released_in_place(paths):
    place = np.array([0.62, -0.1])
    options = {"stops": 1000, "is_blocked": lambda at, held: held and at[0] < 0.5}
    arm = play(paths, {"target": place}, door=FakeDoor(), steps=300, **options)
    (name, position), *_ = arm.released
    assert name == "target" and np.linalg.norm(position[:2] - place) < 0.03 and position[2] < TABLE + 0.08


def test_an_open_door_is_not_pulled_again_while_objects_are_seen(paths):
    door = FakeDoor()
    arm = FakeArm(paths, {}, door)
    perception = FakePerception({}, door, has_objects=True)
    request, rng = Request(np.ones(1, np.float32), None), np.random.default_rng(0)
    episode = KeyframeEpisode(perception, ArmControl(paths, 1), CONFIG.decisions, request, rng, "gripper_camera")
    run = episode.run(arm.view(images=True))
    command = next(run)
    closed = []
    for step in range(150):
        command = run.send(arm.step(command))
        if perception.surveys == 2 and not closed:
            door.handle, door.opening = replace(door.handle, motion=-door.handle.motion), 0.0  # as if it were closed
            closed.append(step)
    assert closed and perception.surveys > 2 and door.opening == 0.0
    assert perception.surveys - 2 == -(-perception.views // 3)  # the first view without the target, and every third one


def test_a_gripper_that_is_stopped_on_the_way_to_a_grasp_does_not_close(paths):
    arm = FakeArm(paths, {"target": np.array([0.62, -0.1])}, stops=1000, is_blocked=lambda at, held: at[0] > 0.48)
    perception, request = FakePerception(arm.blocks, FakeDoor()), Request(np.ones(1, np.float32), None)
    perception.door.opening = 1.0  # nothing to pull
    control, rng = ArmControl(paths, 1), np.random.default_rng(0)
    arm.qpos = paths.reach(from_rotation([0.4, 0.0, 0.3], paths.chain.tcp(REST[None])[0, :3, :3])[None], REST)[1][0]
    run = KeyframeEpisode(perception, control, CONFIG.decisions, request, rng, "gripper_camera").run(arm.view(True))
    command = next(run)
    for _ in range(200):
        command = run.send(arm.step(command))
    assert arm.stops < 1000 and all(gripper == OPEN for _, gripper in arm.trace)


def test_the_gripper_retreats_from_the_place_where_a_pull_has_ended(paths):
    """The pull stops 8 cm before its planned end. A retreat from there would drag the handle."""
    arm = play(paths, {}, door=FakeDoor(end=0.8), steps=60)
    grippers = [gripper for _, gripper in arm.trace]
    first = grippers.index(CLOSED)
    opened = first + grippers[first:].index(OPEN)
    released = arm.trace[opened][0]
    after = [tcp for tcp, gripper in arm.trace[opened:] if gripper == OPEN]
    distances = [np.linalg.norm(tcp[:3, 3] - released[:3, 3]) for tcp in after]
    retreat = np.array([tcp[:3, 3] for tcp, far in zip(after, distances, strict=True) if far < 0.06][:8])
    sideways = np.linalg.norm(np.cross(retreat - released[:3, 3], released[:3, 2]), axis=1)
    assert max(distances) > 0.06 and arm.door.opening == pytest.approx(0.8, abs=0.1) and sideways.max() < 0.005


def observe_with_images(envs):
    height, width = SIZE
    count = len(envs)
    rng = np.random.default_rng(0)
    tcp = ArmPaths(find_robot(DEFAULT_ROBOT)).chain.tcp(REST[None])
    qpos = np.zeros((count, 12), np.float32)
    qpos[:, 3:10] = REST
    return replace(
        observe(envs, qpos=qpos, tcp_in_base=np.tile(to_wxyz(tcp).astype(np.float32), (count, 1))),
        embeddings=np.zeros((count, 384), np.float32),
        images={name: rng.integers(0, 255, (count, height, width, 3), np.uint8) for name in CAMERAS},
        depths={name: rng.integers(300, 900, (count, height, width, 1)).astype(np.int16) for name in CAMERAS},
        intrinsics={
            name: np.tile(np.float32([[32, 0, 32], [0, 32, 32], [0, 0, 1]]), (count, 1, 1)) for name in CAMERAS
        },
        camera_in_base={name: np.tile(tcp.astype(np.float32), (count, 1, 1)) for name in CAMERAS},
    )


def test_policy_requests_images_at_decisions_only():
    torch.manual_seed(0)
    policy = KeyframePolicy(CONFIG, FACTS, KeyframeNetwork(CONFIG, FACTS).eval())
    assert policy.spec.depth and dict(policy.spec.cameras) == dict.fromkeys(CAMERAS, SIZE)
    policy.reset([start(0), start(1)])
    envs = np.array([0, 1])
    requests = []
    for _ in range(6):
        requests.append(policy.requests_images(envs).tolist())
        actions = policy.act(observe_with_images((0, 1)))
        assert actions.shape == (2, 7) and np.isfinite(actions).all()
    assert requests[0] == [True, True] and [False, False] in requests
    policy.reset([start(1)])
    assert policy.requests_images(np.array([1])).tolist() == [True]


def test_a_robot_without_inverse_kinematics_is_refused(monkeypatch):
    description = replace(MOBILE_PANDA, uid="other", inverse_kinematics="robocas_ms3.planning.analytic:Missing")
    monkeypatch.setitem(ROBOTS.builtin, "other", replace(PANDA, description=description))
    policy = KeyframePolicy(CONFIG, FACTS, KeyframeNetwork(CONFIG, FACTS).eval())
    policy.check_robot(DEFAULT_ROBOT)
    with pytest.raises(RobocasError):
        policy.check_robot("other")
