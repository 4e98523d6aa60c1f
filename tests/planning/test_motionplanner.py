"""ManiSkill's motion-planning verbs: errors, dry runs, frames, obstacles and gripper, on ManiSkill's stock Panda."""

from __future__ import annotations

import importlib.util
import sys
from importlib import resources
from itertools import product
from types import SimpleNamespace

import gymnasium as gym
import mani_skill.envs  # noqa: F401  (registers Empty-v1)
import numpy as np
import pytest
import sapien

import robocas_ms3  # noqa: F401  (registers RoboCASPick-v1)
from robocas_ms3.core.errors import PlanningFailed, RobocasError
from robocas_ms3.planning import motionplanner
from robocas_ms3.planning.motionplanner import PandaArmMotionPlanningSolver
from robocas_ms3.planning.protocol import Trajectory

VERBS = ("move_to_pose_with_RRTConnect", "move_to_pose_with_screw")
TURNED = sapien.Pose([0.3, -0.2, 0.1], [np.cos(0.4), 0, 0, np.sin(0.4)])  # of the robot's root
BLOCK = np.array([0.04, 0.04, 0.3])  # m
SIDEWAYS = sapien.Pose(TURNED.to_transformation_matrix()[:3, :3] @ [0, 0.3, 0])  # m, to the robot's left


def make(control_mode: str = "pd_joint_pos", robot: str = "panda") -> gym.Env:
    return gym.make("Empty-v1", robot_uids=robot, control_mode=control_mode, obs_mode="state", render_backend="none")


@pytest.fixture(scope="module", params=["pd_joint_pos", "pd_joint_pos_vel"])
def made(request):
    env = make(request.param)
    yield env
    env.close()


@pytest.fixture
def env(made):
    """The stock Panda at its rest keyframe, on a root that is moved and turned."""
    made.reset(seed=0)
    agent = made.unwrapped.agent
    agent.reset(agent.keyframes["rest"].qpos)
    agent.robot.set_pose(TURNED)
    return made


@pytest.fixture(scope="module")
def joint_env():
    env = make()
    yield env
    env.close()


def tcp(env: gym.Env) -> sapien.Pose:
    return env.unwrapped.agent.tcp.pose.sp


def steps(env: gym.Env) -> int:
    return int(env.unwrapped.elapsed_steps[0])


def distance(a: sapien.Pose, b: sapien.Pose) -> float:
    return float(np.linalg.norm(a.p - b.p))


@pytest.mark.parametrize("verb", VERBS)
def test_a_pose_out_of_reach_raises_and_leaves_the_env_unstepped(env, verb):
    solver, before = PandaArmMotionPlanningSolver(env), env.unwrapped.get_state_dict()
    with pytest.raises(PlanningFailed) as caught:
        getattr(solver, verb)(sapien.Pose([2.0, 0, 0.2], [0, 1, 0, 0]))
    assert caught.value.stage == verb
    assert steps(env) == 0
    after = env.unwrapped.get_state_dict()
    for kind, states in before.items():
        assert all((states[name] == after[kind][name]).all() for name in states)


@pytest.mark.parametrize("verb", VERBS)
def test_a_dry_run_does_not_step_and_its_trajectory_leads_to_the_pose(env, verb):
    solver, goal = PandaArmMotionPlanningSolver(env), sapien.Pose([0, 0.1, 0.1]) * tcp(env)
    planned = getattr(solver, verb)(goal, dry_run=True)
    assert isinstance(planned, Trajectory)
    assert steps(env) == 0
    *_, info = solver.follow_path(planned, refine_steps=10)
    assert steps(env) == int(info["elapsed_steps"][0]) == len(planned.qpos) + 10
    assert distance(tcp(env), goal) < 1e-3
    assert abs(np.dot(tcp(env).q, goal.q)) == pytest.approx(1, abs=1e-5)


@pytest.mark.parametrize("verb", VERBS)
def test_a_motion_returns_the_last_step(env, verb):
    solver, goal = PandaArmMotionPlanningSolver(env), sapien.Pose([0.05, 0, -0.05]) * tcp(env)
    obs, reward, terminated, truncated, info = getattr(solver, verb)(goal, refine_steps=10)
    assert (obs == env.unwrapped.get_obs(info)).all()
    assert len(reward) == len(terminated) == 1
    assert truncated is not None
    assert distance(tcp(env), goal) < 1e-3


def test_base_pose_replaces_the_pose_of_the_simulation(env):
    goal = sapien.Pose([0, 0, -0.1]) * tcp(env)
    moved = sapien.Pose([0, 0, 0.2])
    planned = PandaArmMotionPlanningSolver(env).move_to_pose_with_screw(goal, dry_run=True)
    solver = PandaArmMotionPlanningSolver(env, base_pose=moved * TURNED)
    again = solver.move_to_pose_with_screw(moved * goal, dry_run=True)
    np.testing.assert_allclose(again.qpos, planned.qpos, atol=1e-5)


def test_higher_limits_make_motions_shorter(env):
    goal = sapien.Pose([0, 0.2, 0]) * tcp(env)
    slow, fast = (
        PandaArmMotionPlanningSolver(env, joint_vel_limits=limit, joint_acc_limits=limit) for limit in (0.2, 0.4)
    )
    slow, fast = (solver.move_to_pose_with_RRTConnect(goal, dry_run=True) for solver in (slow, fast))
    assert fast.duration < 0.8 * slow.duration
    for planned, limit in ((slow, 0.2), (fast, 0.4)):
        assert np.abs(np.diff(planned.qpos, axis=0)).max() <= limit * planned.dt * 1.01


def surface(extents: np.ndarray, pose: sapien.Pose, spacing: float = 0.005) -> np.ndarray:
    """Points (P, 3) on the faces of a box, in the world."""
    grid = [np.linspace(-e / 2, e / 2, int(np.ceil(e / spacing)) + 1) for e in extents]
    points = np.array(list(product(*grid)))
    points = points[(np.abs(np.abs(points) - extents / 2) < 1e-9).any(axis=1)]
    return points @ pose.to_transformation_matrix()[:3, :3].T + pose.p


def add_box(solver: PandaArmMotionPlanningSolver, pose: sapien.Pose) -> None:
    solver.add_box_collision(BLOCK, pose)


def add_points(solver: PandaArmMotionPlanningSolver, pose: sapien.Pose) -> None:
    solver.add_collision_pts(surface(BLOCK, pose))


@pytest.mark.parametrize("add", [add_box, add_points])
def test_an_obstacle_blocks_the_straight_line_and_is_passed_on_another_path(env, add):
    solver = PandaArmMotionPlanningSolver(env)
    here, across = tcp(env), SIDEWAYS * tcp(env)
    between = sapien.Pose((here.p + across.p) / 2)
    add(solver, between)
    with pytest.raises(PlanningFailed) as caught:
        solver.move_to_pose_with_screw(across)
    assert caught.value.reason == "straight_line_blocked"
    around = solver.move_to_pose_with_RRTConnect(across, dry_run=True)
    assert solver.planner.free(around.qpos).all()
    solver.clear_collisions()
    straight = solver.move_to_pose_with_screw(across, dry_run=True)
    add(solver, between)
    solver.move_to_pose_with_RRTConnect(across, dry_run=True)
    assert not solver.planner.free(straight.qpos).all()


NOWHERE = sapien.Pose([np.nan, 0, 0.2])
EMPTY = Trajectory(np.zeros((0, 7)), 0.05)
POINTS_WITH_NAN = np.array([[0.5, 0, 0.2], [np.nan, 0, 0]])  # depth images have NaN where the camera measured nothing


@pytest.mark.parametrize(
    ("method", "arguments", "where"),
    [
        *((verb, (NOWHERE,), "pose") for verb in VERBS),
        *((verb, (sapien.Pose(), True, -1), "refine_steps") for verb in VERBS),
        ("follow_path", (Trajectory(np.zeros((1, 7)), 0.05), -1), "refine_steps"),
        ("follow_path", (EMPTY,), "rows of the trajectory"),
        ("open_gripper", (0,), "t"),
        ("close_gripper", (-1,), "t"),
        ("add_box_collision", ([1, 1, 0], sapien.Pose()), "add_box_collision"),
        ("add_box_collision", ([1, 1, np.inf], sapien.Pose()), "add_box_collision"),
        ("add_box_collision", ([1, 1], sapien.Pose()), "add_box_collision"),
        ("add_box_collision", ([1, 1, 1], NOWHERE), "add_box_collision"),
        ("add_collision_pts", (POINTS_WITH_NAN,), "add_collision_pts"),
        ("add_collision_pts", (np.zeros((3, 4)),), "add_collision_pts"),
    ],
)
def test_invalid_arguments_raise_at_the_call(joint_env, method, arguments, where):
    solver = PandaArmMotionPlanningSolver(joint_env)
    gripper, before = solver.gripper_state, steps(joint_env)
    with pytest.raises(RobocasError) as caught:
        getattr(solver, method)(*arguments)
    assert caught.value.where == where
    assert caught.value.expected
    assert str(caught.value.found)
    assert (solver.gripper_state, steps(joint_env)) == (gripper, before)


@pytest.mark.parametrize(
    ("name", "value"),
    [
        *(("joint_vel_limits", limit) for limit in (0.0, np.nan, np.inf)),
        ("joint_acc_limits", -0.9),
        ("base_pose", NOWHERE),
        ("planner", "no_such_planner"),
    ],
)
def test_invalid_options_raise(joint_env, name, value):
    with pytest.raises(RobocasError) as caught:
        PandaArmMotionPlanningSolver(joint_env, **{"backend" if name == "planner" else name: value})
    assert caught.value.where == name


def test_options_of_maniskills_solver_are_accepted_and_others_are_not(joint_env):
    PandaArmMotionPlanningSolver(joint_env, debug=True, visualize_target_grasp_pose=True, print_env_info=True)
    with pytest.raises(TypeError, match="print_info"):
        PandaArmMotionPlanningSolver(joint_env, print_info=True)


def test_a_solution_of_maniskill_solves_its_task(monkeypatch):
    """The original file, loaded by its path: its package imports all solutions, some of which need mplib."""
    package = "mani_skill.examples.motionplanning.panda"
    monkeypatch.setitem(sys.modules, "mplib", None)
    monkeypatch.setitem(sys.modules, f"{package}.motionplanner", motionplanner)
    path = resources.files(package) / "solutions" / "pick_cube.py"
    spec = importlib.util.spec_from_file_location("pick_cube_of_maniskill", str(path))
    solution = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(solution)
    assert solution.PandaArmMotionPlanningSolver is PandaArmMotionPlanningSolver
    env = gym.make("PickCube-v1", obs_mode="state", control_mode="pd_joint_pos", render_backend="none")
    for seed in range(3):
        *_, info = solution.solve(env, seed=seed)
        assert info["success"].item(), seed
    env.close()


@pytest.mark.parametrize("points", [[], np.zeros((0, 3))])
def test_no_points_add_no_obstacle(env, points):
    solver, goal = PandaArmMotionPlanningSolver(env), sapien.Pose([0, 0.1, 0]) * tcp(env)
    planned = solver.move_to_pose_with_screw(goal, dry_run=True)
    solver.add_collision_pts(points)
    np.testing.assert_array_equal(solver.move_to_pose_with_screw(goal, dry_run=True).qpos, planned.qpos)


def test_the_gripper_moves_while_the_arm_stays(env):
    solver = PandaArmMotionPlanningSolver(env)
    here, before = tcp(env), steps(env)
    solver.close_gripper(t=20)
    assert steps(env) == before + 20
    fingers = env.unwrapped.agent.robot.get_qpos()[0, 7:]
    assert float(fingers.max()) < 1e-3
    solver.move_to_pose_with_screw(sapien.Pose([0, 0, -0.05]) * here, refine_steps=5)
    assert float(env.unwrapped.agent.robot.get_qpos()[0, 7:].max()) < 1e-3  # motions hold the command
    assert solver.planner.finger_width < 2e-3
    solver.open_gripper(t=20)
    assert float(env.unwrapped.agent.robot.get_qpos()[0, 7:].min()) > 0.039
    assert distance(tcp(env), sapien.Pose([0, 0, -0.05]) * here) < 1e-3
    solver.close_gripper(t=20, gripper_state=0.0)
    assert 0.01 < float(env.unwrapped.agent.robot.get_qpos()[0, 7]) < 0.02


def test_vis_shows_every_step(joint_env, monkeypatch):
    joint_env.reset(seed=0)
    joint_env.unwrapped.agent.reset(joint_env.unwrapped.agent.keyframes["rest"].qpos)
    shown = []
    monkeypatch.setattr(joint_env.unwrapped, "render_human", lambda: shown.append(steps(joint_env)))
    PandaArmMotionPlanningSolver(joint_env, vis=True).open_gripper(t=3)
    PandaArmMotionPlanningSolver(joint_env).open_gripper(t=3)
    assert shown == [1, 2, 3]


@pytest.mark.parametrize(
    ("control_mode", "robot", "where"),
    [
        ("pd_ee_delta_pose", "panda", "control_mode"),
        ("pd_joint_pos", "panda_stick", "robot"),
        ("pd_joint_pos", "fetch", "robot"),
        ("pd_joint_pos", "panda", "num_envs"),
    ],
)
def test_unsupported_env_is_an_error_with_a_fix(control_mode, robot, where):
    several = SimpleNamespace(unwrapped=SimpleNamespace(num_envs=4))
    env = several if where == "num_envs" else make(control_mode, robot)
    with pytest.raises(RobocasError) as caught:
        PandaArmMotionPlanningSolver(env)
    assert caught.value.where == where
    assert caught.value.found == {"robot": robot, "control_mode": control_mode, "num_envs": 4}[where]
    assert caught.value.fix


@pytest.mark.parametrize("robot", ["panda_wristcam", "robocas_mobile_panda"])
def test_other_robots_with_a_panda_arm(robot):
    if robot == "panda_wristcam":
        env = make(robot=robot)
    else:
        env = gym.make("RoboCASPick-v1", obs_mode="state", control_mode="pd_joint_pos", render_backend="none")
    env.reset(seed=0)
    if robot == "panda_wristcam":
        env.unwrapped.agent.reset(env.unwrapped.agent.keyframes["rest"].qpos)
    solver = PandaArmMotionPlanningSolver(env, base_pose=env.unwrapped.agent.robot.pose)
    goal = sapien.Pose([0, 0.05, 0.05]) * tcp(env)
    solver.move_to_pose_with_RRTConnect(goal, refine_steps=10)
    assert distance(tcp(env), goal) < 2e-3
    env.close()
