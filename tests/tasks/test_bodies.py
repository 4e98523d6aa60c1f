"""States that `BodyStateReader` reads equal those of ManiSkill; contact forces do not depend on an order."""

from types import SimpleNamespace

import gymnasium as gym
import numpy as np
import pytest
import sapien
import torch
from mani_skill.utils.structs import Articulation, Pose

import robocas_ms3.tasks  # noqa: F401
from robocas_ms3.core.errors import RobocasError
from robocas_ms3.robots.description import MOBILE_PANDA
from robocas_ms3.tasks.bodies import BodyStateReader, ContactForceReader

pytestmark = pytest.mark.slow


@pytest.fixture
def env():
    env = gym.make(
        "RoboCASOpenPick-v1",
        config="open_pick_drawer",
        obs_mode="none",
        control_mode="pd_joint_pos",
        render_backend="none",
    )
    env.reset(seed=0)
    yield env
    env.close()


def read_with_maniskill(base) -> torch.Tensor:
    parts = base.scene.get_sim_state()
    return torch.cat([state for found in parts.values() for state in found.values()], dim=1)


def change_state(base):
    """Change pose, velocity or joints of one body after the other; yield after each change."""
    drawer = next(f for f in base.fixtures.furniture.values() if isinstance(f, Articulation))
    robot, thing = base.agent.robot, base.objects[1]
    yield thing.set_pose(Pose.create_from_pq(torch.tensor([[1.0, 2.0, 3.0]])))
    yield thing.set_linear_velocity(torch.tensor([[0.1, 0.2, 0.3]]))
    yield thing.set_angular_velocity(torch.tensor([[1.0, 2.0, 3.0]]))
    yield base.fixtures.basket.set_pose(sapien.Pose([0.5, 0, 1]))
    yield drawer.set_qpos(drawer.get_qpos() + 0.01)
    yield drawer.set_qvel(drawer.get_qvel() + 0.1)
    yield robot.set_qpos(robot.get_qpos() + 0.02)
    yield robot.set_qvel(robot.get_qvel() + 0.2)
    yield robot.set_pose(sapien.Pose([0.1, 0.2, 0.3]))
    yield base.scene.step()


def test_read_is_always_current(env):
    base = env.unwrapped
    before, seen = base.get_state(), []
    for _ in change_state(base):
        seen.append(base.bodies.read())
        assert torch.equal(seen[-1], read_with_maniskill(base))
        assert torch.equal(base.get_state()[:, : seen[-1].shape[1]], read_with_maniskill(base))
        assert torch.equal(base.object_poses, torch.stack([a.pose.raw_pose for a in base.objects], dim=1))
        assert torch.equal(base.basket_pose, base.fixtures.basket.pose.raw_pose)
    assert not any(torch.equal(one, two) for one, two in zip(seen, seen[1:], strict=False))  # and none was written over
    base.set_state(before)
    assert torch.equal(base.bodies.read(), read_with_maniskill(base))
    rng = np.random.default_rng(0)
    for _ in range(5):
        env.step(np.array([*(MOBILE_PANDA.arm_rest + rng.normal(0, 0.2, 7)), -1], np.float32))
        assert torch.equal(base.bodies.read(), read_with_maniskill(base))
    env.reset(seed=1)
    assert torch.equal(base.bodies.read(), read_with_maniskill(base))


def test_state_except_robot_is_unchanged_while_only_the_robot_moves(env):
    base = env.unwrapped
    robot, before = base.agent.robot, base.bodies.read()
    others = base.bodies.state_except_robot
    robot.set_qpos(robot.get_qpos() + 0.02)
    robot.set_pose(sapien.Pose([0.1, 0.2, 0.3]))
    assert not torch.equal(base.bodies.read(), before)
    assert base.bodies.state_except_robot == others
    for _, moved in zip(range(6), change_state(base), strict=False):
        assert moved is None
        base.bodies.read()
        assert base.bodies.state_except_robot != others
        others = base.bodies.state_except_robot


def test_state_dict_equals_the_state_dict_of_maniskill(env):
    base = env.unwrapped
    ours, theirs = base.get_state_dict(), base.scene.get_sim_state()
    assert list(theirs) == ["actors", "articulations"]
    assert list(ours) == [*theirs, "controller", "task"]
    for kind, found in theirs.items():
        assert list(ours[kind]) == list(found)
        for name, state in found.items():
            assert torch.equal(ours[kind][name], state)
    ours["actors"]["basket"][:] = 0  # belongs to whoever asked for it
    assert torch.equal(base.bodies.read(), read_with_maniskill(base))


def test_unexpected_packed_state_is_an_error(env, monkeypatch):
    scene = env.unwrapped.scene
    packed = scene.px.pack()
    system = SimpleNamespace(
        rigid_dynamic_components=scene.px.rigid_dynamic_components,
        articulation_link_components=scene.px.articulation_link_components,
        pack=lambda: packed + b"more",
    )
    monkeypatch.setattr(scene, "px", system)
    with pytest.raises(RobocasError, match="SAPIEN.s packed state"):
        BodyStateReader(scene, env.unwrapped.agent.robot)


def test_forces_do_not_depend_on_the_order_of_the_contacts():
    """As float32, 1 + 6e-8 + 6e-8 is 1 and 6e-8 + 6e-8 + 1 is more than 1."""

    class Box:
        def get_global_aabb_fast(self):
            return np.array([[0.0, 0, 0], [1, 1, 1]])

    finger, cup = Box(), Box()
    impulses = [np.array([value, 0, 0], np.float32) for value in (1.0, 6e-8, 6e-8)]
    contacts = [SimpleNamespace(bodies=(finger, cup), points=[SimpleNamespace(impulse=one)]) for one in impulses]
    found = []
    for ordered in (contacts, contacts[::-1]):
        px = SimpleNamespace(timestep=0.5, get_contacts=lambda ordered=ordered: ordered)
        scene = SimpleNamespace(gpu_sim_enabled=False, px=px)
        reader = ContactForceReader(scene, [SimpleNamespace(_bodies=[finger])], [SimpleNamespace(_bodies=[cup])])
        found.append(reader.read_forces())
    np.testing.assert_array_equal(*found)
    assert found[0].dtype == np.float32 and found[0].shape == (1, 1, 1, 3)
    assert found[0][0, 0, 0].tolist() == [np.float32(2.0000002384185791), 0, 0]
