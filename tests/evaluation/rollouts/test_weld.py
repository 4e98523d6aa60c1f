"""RoboCAS-v0's weld: lifted objects are fixed to the hand until the gripper is commanded to open."""

from __future__ import annotations

from typing import Any

import gymnasium as gym
import numpy as np
import pytest
import sapien
import torch

import robocas_ms3  # noqa: F401
from robocas_ms3.evaluation.policies import make_policy
from robocas_ms3.evaluation.policy import PolicySpec
from robocas_ms3.evaluation.protocols.protocol import load_protocol
from robocas_ms3.evaluation.results.metrics import read_metric
from robocas_ms3.evaluation.results.result_files import read_result
from robocas_ms3.evaluation.results.verify import find_violations
from robocas_ms3.evaluation.rollouts.action_wrapper import PolicyActionWrapper, make_env_kwargs
from robocas_ms3.evaluation.rollouts.session import EvaluationSession
from robocas_ms3.evaluation.settings import EvaluationSettings
from robocas_ms3.robots.description import MOBILE_PANDA

OPEN, CLOSE = 1.0, 0.0


class ClaimsSuccess(gym.Wrapper):
    """Environment whose task succeeds at each step."""

    def step(self, action: Any) -> Any:
        *others, info = self.env.step(action)
        return (*others, {**info, "success": torch.tensor([True])})


def make(**kwargs: Any) -> gym.Env:
    return gym.make("RoboCASPick-v1", **make_env_kwargs(PolicySpec(), 5), **kwargs)


@pytest.fixture(scope="module")
def pick():
    return make()


def wrap(env: gym.Env, weld: bool = True) -> PolicyActionWrapper:
    stepped = PolicyActionWrapper(env, PolicySpec("robocas", "tcp"), "upstream", weld=weld)
    stepped.reset(seed=3)
    return stepped


def stay(gripper: float) -> np.ndarray:
    return np.array([0, 0, 0, 0, 0, 0, gripper])


def target(env: PolicyActionWrapper) -> Any:
    base: Any = env.unwrapped
    return base.objects[int(base.target_slot)]._bodies[0]


def grasp(env: PolicyActionWrapper, above: float | None = None) -> dict[str, Any]:
    """Close the fingers on the target, placed at the TCP in the air; ``above``: raised height, m."""
    base: Any = env.unwrapped
    body = target(env)
    pose = sapien.Pose(base.agent.tcp.pose.sp.p, [1, 0, 0, 0])
    if above is not None:
        base.start_poses[0, base.target_slot, 2] = float(pose.p[2]) - above
    body.disable_gravity = True
    body.entity.set_pose(pose)
    body.set_linear_velocity(np.zeros(3))
    body.set_angular_velocity(np.zeros(3))
    *_, info = env.step(stay(CLOSE))
    body.disable_gravity = False
    return info


def open_fingers(env: PolicyActionWrapper) -> None:
    """Open the fingers without a gripper command."""
    for _ in range(3):
        env.env.step(torch.tensor([[0, 0, 0, 0, 0, 0, OPEN]]))


def pose_in_hand(env: PolicyActionWrapper) -> sapien.Pose:
    base: Any = env.unwrapped
    return base.agent.robot.links_map[MOBILE_PANDA.hand_link]._bodies[0].entity_pose.inv() * target(env).entity_pose


def test_welded_object_keeps_its_pose_in_the_hand_while_arm_and_fingers_move(pick):
    env, rng = wrap(pick), np.random.default_rng(0)
    assert float(grasp(env)["welds"]) == 1
    before = pose_in_hand(env)
    shifts, turns = [], []
    for number in range(40):
        if number % 10 == 0:
            open_fingers(env)
        *_, info = env.step(np.concatenate([rng.uniform(-0.1, 0.1, 3), rng.uniform(-0.4, 0.4, 3), [CLOSE]]))
        gone = before.inv() * pose_in_hand(env)
        shifts.append(np.linalg.norm(gone.p))
        turns.append(2 * np.arcsin(min(1.0, np.linalg.norm(gone.q[1:]))))
    assert np.isfinite(target(env).linear_velocity).all()
    assert max(shifts) < 0.001  # m
    assert max(turns) < np.deg2rad(0.5)
    assert read_metric(info, "path_length") > 1  # the arm moved
    assert float(info["welds"]) == 1


@pytest.mark.parametrize("weld", [True, False])
def test_welded_object_falls_when_the_gripper_is_commanded_to_open(pick, weld):
    env = wrap(pick, weld)
    grasp(env)
    height = target(env).entity_pose.p[2]
    open_fingers(env)
    fallen = height - target(env).entity_pose.p[2]
    assert fallen == pytest.approx(0, abs=0.001) if weld else fallen > 0.3
    env.step(stay(OPEN))
    env.step(stay(OPEN))
    assert height - target(env).entity_pose.p[2] > 0.3


def test_object_is_welded_once_per_grasp(pick):
    env = wrap(pick)
    counts = [grasp(env)["welds"], env.step(stay(CLOSE))[-1]["welds"], env.step(stay(OPEN))[-1]["welds"]]
    counts += [grasp(env)["welds"]]
    assert [float(count) for count in counts] == [1, 1, 1, 2]


def test_object_near_the_table_or_touched_by_one_finger_is_not_welded(pick, monkeypatch):
    env = wrap(pick)
    info = grasp(env, above=0.025)
    assert bool(info["target_grasped"])
    assert float(info["welds"]) == 0
    assert float(grasp(env, above=0.035)["welds"]) == 1
    env = wrap(pick)
    base: Any = env.unwrapped
    forces = torch.zeros(1, 3, len(base.objects), 3)
    forces[0, 0] = forces[0, 2] = 5.0  # N on the left finger and the hand
    monkeypatch.setattr(base, "gripper_forces", lambda: forces)
    assert float(grasp(env)["welds"]) == 0


def test_no_success_while_an_object_is_welded(pick):
    env = wrap(ClaimsSuccess(pick))
    assert not bool(grasp(env)["success"])
    open_fingers(env)  # in the basket and at rest, but still welded
    assert not bool(env.step(stay(CLOSE))[-1]["success"])
    assert bool(env.step(stay(OPEN))[-1]["success"])


@pytest.mark.parametrize("reconfiguration_freq", [0, 1])
def test_reset_removes_the_weld(reconfiguration_freq):
    env = wrap(make(reconfiguration_freq=reconfiguration_freq))
    base: Any = env.unwrapped
    grasp(env)
    _, info = env.reset(seed=4)
    assert float(info["welds"]) == 0
    for _ in range(4):
        *_, info = env.step(np.array([0, 0, -0.08, 0, 0, 0, CLOSE]))
    assert float(info["welds"]) == 0
    assert read_metric(info, "path_length") > 0.2
    shift = (base.object_poses - base.start_poses)[0, :, :3].norm(dim=-1)
    assert float(shift[base.present[0]].max()) < 0.005
    env.step(stay(OPEN))
    assert float(grasp(env)["welds"]) == 1  # the count starts at 0
    env.close()


def test_weld_option_has_no_effect_without_a_lifted_object(pick):
    poses = []
    for weld in (False, True):
        env, rng = wrap(pick, weld), np.random.default_rng(1)
        base: Any = env.unwrapped
        for _ in range(10):
            *_, info = env.step(np.concatenate([rng.uniform(-0.05, 0.05, 6), [rng.integers(2)]]))
        poses.append((base.object_poses.clone(), base.agent.robot.get_qpos().clone(), info["sums"]))
    assert float(info["welds"]) == 0
    assert all(torch.equal(one, other) for one, other in zip(*poses, strict=True))


@pytest.mark.slow
def test_evaluation_with_the_weld_counts_and_records_welds(tmp_path):
    protocol, folder = load_protocol("paper-v1"), tmp_path / "out"
    name, settings = "scripted-ee-delta", {"episodes": 1, "envs": 1, "backend": "processes", "weld": True}
    settings = EvaluationSettings(("pick",), name, str(protocol.folder), folder, **settings)
    (outcome,) = EvaluationSession(make_policy(name), settings).run()
    assert outcome.success and outcome.measures["welds"] == 1
    result = read_result(folder)
    assert result.run.weld
    assert find_violations(result, protocol) == ["399 of 400 episodes missing"]
