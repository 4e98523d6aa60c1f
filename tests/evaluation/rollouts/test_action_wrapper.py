"""Actions, images and metrics of the environment wrapper of policies."""

from __future__ import annotations

from functools import cache, partial
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
import torch
from mani_skill.utils.structs import Pose

import robocas_ms3  # noqa: F401
from robocas_ms3.core.errors import EvaluationError, VectorEnvError
from robocas_ms3.evaluation.policy import PolicySpec
from robocas_ms3.evaluation.results.metrics import EpisodeMetrics, read_metric
from robocas_ms3.evaluation.rollouts.action_wrapper import PolicyActionWrapper, make_env_kwargs
from robocas_ms3.tasks.vector import make_vec

needs_cuda = pytest.mark.skipif(not torch.cuda.is_available(), reason="no CUDA device: unproven on a GPU")


IMAGES = {
    "obs_mode": "rgb",
    "reward_mode": "none",
    "control_mode": "pd_ee_delta_pose",
    "sim_config": {"control_freq": 5},
    "sensor_configs": {"width": 32, "height": 24},
    "max_episode_steps": 10_000,
}


@cache
def pick(convention: str, rate: int) -> gym.Env:
    return gym.make("RoboCASPick-v1", **make_env_kwargs(PolicySpec(convention), rate))


def made(convention="robocas", reference="tcp", stepping="timed", rate=5) -> PolicyActionWrapper:
    stepped = PolicyActionWrapper(pick(convention, rate), PolicySpec(convention, reference), stepping)
    stepped.reset(seed=3)
    return stepped


def tcp(env: PolicyActionWrapper) -> np.ndarray:
    base: Any = env.unwrapped
    return base.agent.tcp_in_arm_base.p[0].numpy().copy()


def along(z: float, gripper: float = 1.0) -> np.ndarray:
    return np.array([0, 0, z, 0, 0, 0, gripper])


@pytest.mark.parametrize("reference", ["tcp", "target"])
def test_slow_motion_reaches_its_goal(reference):
    env = made(reference=reference)
    before = tcp(env)
    for _ in range(5):
        *_, info = env.step(along(0.02))
    assert np.linalg.norm(tcp(env) - before) == pytest.approx(0.1, abs=0.004)
    assert read_metric(info, "path_length") == pytest.approx(0.1, abs=0.004)


def test_a_checkpoint_has_the_state_and_the_gripper_command():
    env = PolicyActionWrapper(pick("robocas", 5), PolicySpec("robocas"), "timed", checkpoints=True)
    _, info = env.reset(seed=3)
    assert info["checkpoint"][0, -2] == 1  # open
    *_, info = env.step(along(0.02, 0.0))
    base: Any = env.unwrapped
    checkpoint, bodies = info["checkpoint"][0], base.bodies.read()[0]
    assert checkpoint[: len(bodies)].equal(bodies) and checkpoint[-2] == 0
    assert (env.get_info()["checkpoint"][0] == checkpoint).all()  # nothing was simulated


@pytest.mark.parametrize("observed", [False, True])
def test_privileged_state_is_only_computed_for_policies_that_observe_it(observed):
    env = PolicyActionWrapper(pick("robocas", 5), PolicySpec("robocas", state=observed, track="privileged"), "timed")
    obs, _ = env.reset(seed=3)
    assert ("object_poses" in obs["extra"]) == observed
    assert (set(obs["extra"]) == {"tcp_pose"}) == (not observed)


def test_poses_and_joints_return_to_a_checkpoint_but_velocities_do_not():
    env = PolicyActionWrapper(pick("robocas", 5), PolicySpec("robocas"), "timed", checkpoints=True)
    env.reset(seed=3)
    *_, info = env.step(along(0.02))
    checkpoint, base = info["checkpoint"][0].numpy(), env.unwrapped
    bodies = base.bodies.read().shape[1]
    assert env.restore_checkpoint(checkpoint, 0.0) == ((0, 0, 0, 0), [])
    for _ in range(3):
        env.step(along(0.02))
    slot = int(base.target_slot[0])
    target, other, near = (base.objects[(slot + i) % int(base.present[0].sum())] for i in range(3))
    for body, shift in ((target, 0.03), (other, 0.02), (near, 0.008)):
        pose = body.pose.raw_pose.clone()
        pose[:, 1] += shift
        body.set_pose(Pose.create(pose))
    before = base.bodies.read()[0].numpy().copy()
    forged = checkpoint.copy()
    first = base.bodies.actors.index(target.name) * 13
    forged[first + 7 : first + 13] = 9.0  # a velocity
    deviation, _ = env.restore_checkpoint(forged, np.inf)
    assert deviation.target == deviation.body == pytest.approx(0.03, abs=1e-3)
    assert deviation.moved == pytest.approx(0.02, abs=1e-3)  # neither the target nor small distances
    turned = np.abs(base.agent.robot.qpos[0].numpy() - qpos_in(base, checkpoint)).max()
    assert deviation.joint == pytest.approx(turned) and turned > 0.02
    assert (base.bodies.read()[0].numpy() == before).all()  # only measured
    assert env.restore_checkpoint(forged, 0.05) == (deviation, [])  # a joint is farther away
    after = base.bodies.read()[0].numpy()
    np.testing.assert_allclose(base.agent.robot.qpos[0], qpos_in(base, checkpoint), atol=1e-5)
    np.testing.assert_allclose(after[first : first + 7], checkpoint[first : first + 7], atol=1e-5)
    np.testing.assert_allclose(after[first + 7 : first + 13], before[first + 7 : first + 13], atol=1e-5)
    assert (after[:bodies] != before).any()


def test_stages_that_a_checkpoint_lacks_are_lost(monkeypatch):
    forgotten = []
    monkeypatch.setattr(EpisodeMetrics, "forget_grasp", lambda metrics: forgotten.append("grasp"))
    env = PolicyActionWrapper(pick("robocas", 5), PolicySpec("robocas"), "timed", checkpoints=True)
    env.reset(seed=3)
    *_, info = env.step(along(0.02))
    checkpoint, base = info["checkpoint"][0].numpy(), env.unwrapped
    stages: Any = base.success_check.stages
    stages["picked_any"][:] = True
    *_, info = env.step(along(0.02))
    picked = info["checkpoint"][0].numpy()
    stages["target_lifted"][:] = True
    env.step(along(0.02))
    stages["target_in_basket"][:] = True
    assert env.restore_checkpoint(picked, 0.0)[1] == ["target_lifted", "target_in_basket"]
    assert stages["picked_any"].all() and not stages["target_lifted"].any()
    env.restore_checkpoint(checkpoint, np.inf)  # only measures
    assert stages["picked_any"].all()
    env.restore_checkpoint(checkpoint, 0.0)
    assert not stages["picked_any"].any()
    env.restore_checkpoint(picked, 0.0)
    assert not stages["picked_any"].any()  # only the simulation reaches a stage
    assert not forgotten
    stages["target_grasped"][:] = True
    assert env.restore_checkpoint(checkpoint, 0.0)[1] == ["target_grasped"] and forgotten == ["grasp"]


def qpos_in(base: Any, checkpoint: np.ndarray) -> np.ndarray:
    """Return the joint positions of the robot in a checkpoint."""
    row = torch.from_numpy(checkpoint)[None, : base.bodies.read().shape[1]]
    return base.bodies.to_state_dict(row)["articulations"][base.agent.robot.name][0, 13 : 13 + 12].numpy()


def test_motions_start_from_the_tcp_or_from_the_last_commanded_pose():
    gone = {}
    for reference in ("tcp", "target"):
        env = made(reference=reference)
        base: Any = env.unwrapped
        env.step(along(0.02))
        sent = tcp(env)
        qpos = base.agent.robot.get_qpos().clone()
        qpos[0, 4] += 0.03  # the arm was displaced
        base.agent.robot.set_qpos(qpos)
        pushed = np.linalg.norm(tcp(env) - sent)
        env.step(along(0.0))
        gone[reference] = np.linalg.norm(tcp(env) - sent) / pushed
    assert gone["tcp"] > 0.8  # stays at the displaced pose
    assert gone["target"] < 0.2  # returns


def test_joint_targets_are_executed_unchanged():
    env = made("joint_positions", rate=20)
    base: Any = env.unwrapped
    wanted = base.agent.robot.get_qpos()[0, 3:10].numpy() + 0.05
    for _ in range(20):
        env.step(np.append(wanted, 1.0))
    np.testing.assert_allclose(base.agent.robot.get_qpos()[0, 3:10].numpy(), wanted, atol=0.01)


def test_action_noise_depends_on_the_seed_only_and_has_the_given_size():
    def moved(seed: int, noise: tuple[float, float]) -> np.ndarray:
        env = PolicyActionWrapper(pick("robocas", 5), PolicySpec("robocas", "target"), "timed", action_noise=noise)
        env.reset(seed=seed)
        before = tcp(env)
        for _ in range(40):
            env.step(along(0.0))
        return tcp(env) - before

    assert np.linalg.norm(moved(3, (0.0, 0.0))) < 1e-4
    first, again, other = moved(3, (2.0, 0.0)), moved(3, (2.0, 0.0)), moved(4, (2.0, 0.0))
    assert np.array_equal(first, again) and not np.allclose(first, other, atol=1e-3)
    # 40 motions with 2 mm per component add up to 2 mm * sqrt(40) = 12.6 mm per component
    assert 0.004 < np.linalg.norm([first, other]) / np.sqrt(6) < 0.035


def test_simulation_state_continues_in_another_env():
    env = PolicyActionWrapper(pick("robocas", 5), PolicySpec("robocas", "tcp", simulation_state=True), "timed")
    env.reset(seed=3)
    for _ in range(3):
        obs, *_ = env.step(along(0.02, gripper=0.0))
    assert obs["simulation"]["gripper"].tolist() == [-1.0]
    values, base = obs["simulation"]["values"], env.unwrapped
    stages = values["task"]["stages"].clone()
    stages[0, 0] = True
    wanted = {kind: {name: rows.clone() for name, rows in of.items()} for kind, of in values.items()}
    env.reset(seed=3)
    base.set_state_dict({**wanted, "task": {"stages": stages}})
    found = base.get_state_dict()
    for kind in ("actors", "articulations"):
        for name, rows in wanted[kind].items():
            np.testing.assert_allclose(found[kind][name], rows, atol=1e-5)
    assert found["task"]["stages"].tolist() == stages.tolist()


def test_v0_step_waits_for_gripper_and_motion():
    env = made(stepping="upstream")
    base: Any = env.unwrapped

    def steps(action: np.ndarray) -> int:
        before = int(base.elapsed_steps)
        env.step(action)
        return int(base.elapsed_steps) - before

    with pytest.raises(EvaluationError, match="NaN or infinite action"):
        env.step(np.full(7, np.nan))
    assert steps(along(0.01)) == 1  # arrives within 0.2 s
    before = tcp(env)
    assert steps(along(0.15)) == 2  # at most 10 cm per control step
    assert np.linalg.norm(tcp(env) - before) == pytest.approx(0.15, abs=0.02)
    shutting = steps(along(0.0, gripper=0.0))
    assert 2 < shutting <= 7
    assert float(base.agent.gripper_width) < 0.01
    assert steps(along(0.0, gripper=0.0)) <= 2  # the gripper has stopped, although its drives press


def test_metrics_count_from_the_reset():
    env = made()
    base: Any = env.unwrapped
    slot = int(base.target_slot)
    for _ in range(3):
        env.step(along(0.02))
    pose = base.objects[slot].pose.raw_pose.clone()
    above = torch.cat([base.basket_pose[:, :2], pose[:, 2:3]], dim=1)
    base.objects[slot].set_pose(Pose.create_from_pq(above, pose[:, 3:]))
    *_, info = env.step(along(0.0))
    assert bool(info["success_v0"])  # near the basket in xy, gripper open: RoboCAS-v0's rule has no other condition
    assert read_metric(info, "v0_steps") == 1
    assert not bool(info["success"])
    other = next(i for i in range(len(base.objects)) if i != slot)
    pose = base.objects[other].pose.raw_pose.clone()
    base.objects[other].set_pose(Pose.create_from_pq(torch.tensor([[3.0, 3.0, 0.05]]), pose[:, 3:]))
    *_, info = env.step(along(0.0, gripper=0.0))
    assert not bool(info["success_v0"])
    assert read_metric(info, "fallen") == 1
    assert read_metric(info, "disturbed_most") >= 1
    base.objects[slot].set_pose(Pose.create_from_pq(torch.tensor([[3.0, 2.0, 0.05]]), pose[:, 3:]))
    *_, info = env.step(along(0.0))
    assert bool(info["fail"])
    assert read_metric(info, "fallen") == 1  # the target does not count
    env.reset(seed=3)
    *_, info = env.step(along(0.0))
    assert [read_metric(info, name) for name in ("fallen", "disturbed_most", "v0_steps")] == [0, 0, 0]
    assert read_metric(info, "path_length") < 0.002


def test_images_are_rendered_only_on_request(monkeypatch):
    env = gym.make("RoboCASPick-v1", **IMAGES)
    base: Any = env.unwrapped
    rendered, capture = [], base.capture_sensor_data
    monkeypatch.setattr(base, "capture_sensor_data", lambda: (rendered.append(1), capture()))
    stepped = PolicyActionWrapper(env, PolicySpec("robocas", "tcp"), "upstream")
    obs, _ = stepped.reset(seed=3)
    first = base.render_images()
    for _ in range(3):
        obs, *_, info = stepped.step(along(0.08))
    assert len(rendered) == 1 and not {"sensor_data", "sensor_param"} & obs.keys()
    images = base.render_images()
    assert {name: tuple(one["rgb"].shape) for name, one in images.items()} == dict.fromkeys(
        base._sensors, (1, 24, 32, 3)
    )
    assert not torch.equal(images["gripper_camera"]["rgb"], first["gripper_camera"]["rgb"])
    base.observes_images = True
    now = base.get_obs()["sensor_data"]
    assert all(torch.equal(images[name]["rgb"], now[name]["rgb"]) for name in images)
    env.close()


def check_rendered_envs(backend: str) -> None:
    """Images of chosen envs, in their order, equal the images of all envs."""
    envs = make_vec(
        "RoboCASPick-v1",
        4,
        backend=backend,
        arrays="numpy",
        workers=2,
        auto_reset=False,
        ignore_terminations=True,
        record_metrics=False,
        wrappers=[partial(PolicyActionWrapper, spec=PolicySpec("robocas", "tcp"), stepping="upstream")],
        **IMAGES,
    )
    obs, _ = envs.reset(seed=[3, 4, 5, 6])
    assert "sensor_data" not in obs
    envs.step(np.tile(along(0.02), (4, 1)))
    every, chosen = envs.render_images(np.arange(4)), envs.render_images(np.array([3, 0]))
    for camera, images in every.items():
        assert images["rgb"].shape == (4, 24, 32, 3)
        np.testing.assert_array_equal(chosen[camera]["rgb"], images["rgb"][[3, 0]])
    rgb = every["base_camera"]["rgb"]
    assert all((rgb[i] != rgb[j]).any() for i in range(4) for j in range(i))
    if backend == "processes":
        with pytest.raises(VectorEnvError, match="invalid env_idx"):
            envs.render_images(np.array([4]))
    envs.close()


def test_chosen_envs_are_rendered_in_their_processes():
    check_rendered_envs("processes")


@pytest.mark.gpu
@needs_cuda
def test_chosen_envs_of_a_batch_are_rendered():
    check_rendered_envs("gpu")
