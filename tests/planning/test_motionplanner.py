"""Methods of ManiSkill's motion-planning solver with ManiSkill's Panda: errors, frames, obstacles and gripper."""

from __future__ import annotations

import importlib.util
import sys
from importlib import resources
from types import SimpleNamespace

import gymnasium as gym
import mani_skill.envs  # noqa: F401  (registers Empty-v1)
import numpy as np
import pytest
import sapien
from planning_scenes import Box

import robocas_ms3  # noqa: F401  (registers RoboCASPick-v1)
from robocas_ms3.core.errors import PlanningError, RobocasError
from robocas_ms3.planning import motionplanner
from robocas_ms3.planning.motionplanner import PandaArmMotionPlanningSolver

VERBS = ("move_to_pose_with_RRTConnect", "move_to_pose_with_screw")
TURNED = sapien.Pose([0.3, -0.2, 0.1], [np.cos(0.4), 0, 0, np.sin(0.4)])  # of the robot's root
BLOCK = np.array([0.04, 0.04, 0.3])  # m
SIDEWAYS = sapien.Pose(TURNED.to_transformation_matrix()[:3, :3] @ [0, 0.3, 0])  # m, to the robot's left
NOWHERE = sapien.Pose([np.nan, 0, 0.2])


def make(control_mode: str = "pd_joint_pos", robot: str = "panda") -> gym.Env:
    return gym.make("Empty-v1", robot_uids=robot, control_mode=control_mode, obs_mode="state", render_backend="none")


@pytest.fixture(scope="module", params=["pd_joint_pos", "pd_joint_pos_vel"])
def made(request):
    env = make(request.param)
    yield env
    env.close()


@pytest.fixture
def env(made):
    """Environment with ManiSkill's Panda at its rest keyframe, on a moved and rotated root."""
    made.reset(seed=0)
    agent = made.unwrapped.agent
    agent.reset(agent.keyframes["rest"].qpos)
    agent.robot.set_pose(TURNED)
    return made


def tcp(env: gym.Env) -> sapien.Pose:
    return env.unwrapped.agent.tcp.pose.sp


def steps(env: gym.Env) -> int:
    return int(env.unwrapped.elapsed_steps[0])


def distance(a: sapien.Pose, b: sapien.Pose) -> float:
    return float(np.linalg.norm(a.p - b.p))


@pytest.mark.parametrize("verb", VERBS)
def test_motion_reaches_its_pose_and_failed_plan_does_not_step(env, verb):
    solver, goal = PandaArmMotionPlanningSolver(env), sapien.Pose([0, 0.1, 0.1]) * tcp(env)
    with pytest.raises(PlanningError) as caught:
        getattr(solver, verb)(sapien.Pose([2.0, 0, 0.2], [0, 1, 0, 0]))
    assert caught.value.stage == verb
    planned = getattr(solver, verb)(goal, dry_run=True)
    assert steps(env) == 0
    obs, *_, info = solver.follow_path(planned, refine_steps=10)
    assert steps(env) == int(info["elapsed_steps"][0]) == len(planned.qpos) + 10
    assert (obs == env.unwrapped.get_obs(info)).all()
    assert distance(tcp(env), goal) < 1e-3
    assert abs(np.dot(tcp(env).q, goal.q)) == pytest.approx(1, abs=1e-5)
    getattr(solver, verb)(sapien.Pose([0.05, 0, -0.05]) * goal, refine_steps=10)
    assert distance(tcp(env), sapien.Pose([0.05, 0, -0.05]) * goal) < 1e-3


def test_limits_change_the_plan(env):
    goal, moved = sapien.Pose([0, 0, -0.1]) * tcp(env), sapien.Pose([0, 0, 0.2])
    planned = PandaArmMotionPlanningSolver(env).move_to_pose_with_screw(goal, dry_run=True)
    elsewhere = PandaArmMotionPlanningSolver(env, base_pose=moved * TURNED)
    again = elsewhere.move_to_pose_with_screw(moved * goal, dry_run=True)
    np.testing.assert_allclose(again.qpos, planned.qpos, atol=1e-5)
    slow = PandaArmMotionPlanningSolver(env, joint_vel_limits=0.2, joint_acc_limits=0.2)
    assert slow.move_to_pose_with_screw(goal, dry_run=True).duration > 1.25 * planned.duration


def add_box(solver: PandaArmMotionPlanningSolver, pose: sapien.Pose) -> None:
    solver.add_box_collision(BLOCK, pose)


def add_points(solver: PandaArmMotionPlanningSolver, pose: sapien.Pose) -> None:
    solver.add_collision_pts([])
    solver.add_collision_pts(Box(tuple(pose.p), tuple(BLOCK)).surface())


@pytest.mark.parametrize("add", [add_box, add_points])
def test_obstacle_blocks_the_straight_line_but_not_rrt_connect(env, add):
    solver = PandaArmMotionPlanningSolver(env)
    here, across = tcp(env), SIDEWAYS * tcp(env)
    between = sapien.Pose((here.p + across.p) / 2)
    add(solver, between)
    with pytest.raises(PlanningError) as caught:
        solver.move_to_pose_with_screw(across)
    assert caught.value.reason == "straight_line_blocked"
    around = solver.move_to_pose_with_RRTConnect(across, dry_run=True)
    assert solver.planner.is_free(around.qpos).all()
    solver.clear_collisions()
    straight = solver.move_to_pose_with_screw(across, dry_run=True)
    add(solver, between)
    solver.move_to_pose_with_RRTConnect(across, dry_run=True)
    assert not solver.planner.is_free(straight.qpos).all()


def test_gripper_moves_without_the_arm_and_vis_renders_each_step(env, monkeypatch):
    shown = []
    monkeypatch.setattr(env.unwrapped, "render_human", lambda: shown.append(steps(env)))
    solver, here, robot = PandaArmMotionPlanningSolver(env), tcp(env), env.unwrapped.agent.robot
    solver.close_gripper(t=20)
    assert steps(env) == 20
    solver.move_to_pose_with_screw(sapien.Pose([0, 0, -0.05]) * here, refine_steps=5)
    assert float(robot.get_qpos()[0, 7:].max()) < 1e-3  # motions hold the command
    assert solver.planner.finger_width < 2e-3
    assert shown == []
    PandaArmMotionPlanningSolver(env, vis=True).open_gripper(t=20)
    assert len(shown) == 20
    assert float(robot.get_qpos()[0, 7:].min()) > 0.039
    assert distance(tcp(env), sapien.Pose([0, 0, -0.05]) * here) < 1e-3
    solver.close_gripper(t=20, gripper_state=0.0)
    assert 0.01 < float(robot.get_qpos()[0, 7]) < 0.02


@pytest.mark.parametrize(
    ("method", "arguments", "where"),
    [
        *((verb, (NOWHERE,), "pose") for verb in VERBS),
        ("add_box_collision", ([1, 1, 0], sapien.Pose()), "add_box_collision"),
        ("add_box_collision", ([1, 1, 1], NOWHERE), "add_box_collision"),
        # depth images have NaN where the camera measured nothing
        ("add_collision_pts", (np.array([[0.5, 0, 0.2], [np.nan, 0, 0]]),), "add_collision_pts"),
        ("add_collision_pts", (np.zeros((3, 6)),), "add_collision_pts"),  # a point per column
        ("open_gripper", (0,), "t"),
    ],
)
def test_invalid_poses_and_points_are_errors(env, method, arguments, where):
    with pytest.raises(RobocasError) as caught:
        getattr(PandaArmMotionPlanningSolver(env), method)(*arguments)
    assert (caught.value.where, steps(env)) == (where, 0)


def test_arguments_of_maniskills_solver_are_accepted_and_unknown_ones_are_errors(env):
    PandaArmMotionPlanningSolver(env, debug=True, visualize_target_grasp_pose=True, print_env_info=True)
    with pytest.raises(TypeError, match="print_info"):
        PandaArmMotionPlanningSolver(env, print_info=True)
    for name, value in (("joint_vel_limits", 0.0), ("joint_acc_limits", np.nan), ("backend", "no_such_planner")):
        with pytest.raises(RobocasError) as caught:
            PandaArmMotionPlanningSolver(env, **{name: value})
        assert caught.value.where == ("planner" if name == "backend" else name)


def test_solution_of_maniskill_solves_its_task(monkeypatch):
    """The original file is loaded by its path, since its package imports solutions that need mplib."""
    package = "mani_skill.examples.motionplanning.panda"
    monkeypatch.setitem(sys.modules, "mplib", None)
    monkeypatch.setitem(sys.modules, f"{package}.motionplanner", motionplanner)
    path = resources.files(package) / "solutions" / "pick_cube.py"
    spec = importlib.util.spec_from_file_location("pick_cube_of_maniskill", str(path))
    solution = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(solution)
    assert solution.PandaArmMotionPlanningSolver is PandaArmMotionPlanningSolver
    env = gym.make("PickCube-v1", obs_mode="state", control_mode="pd_joint_pos", render_backend="none")
    *_, info = solution.solve(env, seed=0)
    assert info["success"].item()
    env.close()


@pytest.mark.parametrize(
    ("control_mode", "robot", "where"),
    [
        ("pd_ee_delta_pose", "panda", "control_mode"),
        ("pd_joint_pos", "fetch", "robot_uids"),
        ("pd_joint_pos", "panda", "num_envs"),
    ],
)
def test_unsupported_env_is_an_error_with_a_fix(control_mode, robot, where):
    several = SimpleNamespace(unwrapped=SimpleNamespace(num_envs=4))
    env = several if where == "num_envs" else make(control_mode, robot)
    with pytest.raises(RobocasError) as caught:
        PandaArmMotionPlanningSolver(env)
    assert caught.value.where == where
    assert caught.value.found == {"robot_uids": robot, "control_mode": control_mode, "num_envs": 4}[where]
    assert caught.value.fix


@pytest.mark.parametrize("robot", ["panda_wristcam", "robocas_mobile_panda"])
def test_supported_robots_with_a_panda_arm(robot):
    if robot == "panda_wristcam":
        env = make(robot=robot)
        env.reset(seed=0)
        env.unwrapped.agent.reset(env.unwrapped.agent.keyframes["rest"].qpos)
    else:
        env = gym.make("RoboCASPick-v1", obs_mode="state", control_mode="pd_joint_pos", render_backend="none")
        env.reset(seed=0)
    goal = sapien.Pose([0, 0.05, 0.05]) * tcp(env)
    PandaArmMotionPlanningSolver(env).move_to_pose_with_RRTConnect(goal, refine_steps=10)
    assert distance(tcp(env), goal) < 2e-3
    env.close()
