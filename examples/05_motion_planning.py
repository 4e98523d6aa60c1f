"""Solve ManiSkill's PickCube-v1 or RoboCASPick-v1 by motion planning, in the style of ManiSkill's solutions.

python examples/05_motion_planning.py --env PickCube-v1 --seed 0 --episodes 10
python examples/05_motion_planning.py --env RoboCASPick-v1 --image end.png

The solution of RoboCASPick-v1 imports modules of the motion planner, which are not a part of the public API.
"""

from pathlib import Path
from typing import Literal

import cv2
import gymnasium as gym
import mani_skill.envs  # noqa: F401  (registers PickCube-v1)
import numpy as np
import sapien
import tyro
from mani_skill.examples.motionplanning.base_motionplanner.utils import compute_grasp_info_by_obb, get_actor_obb

import robocas_ms3  # noqa: F401  (registers RoboCASPick-v1)
from robocas_ms3 import PlanningError
from robocas_ms3.core.poses import inverse, transform_points
from robocas_ms3.planning.grasp_choice import compute_grip_margins, filter_grasps
from robocas_ms3.planning.motionplanner import PandaArmMotionPlanningSolver
from robocas_ms3.planning.protocol import AttachedBody
from robocas_ms3.planning.scene import SPACING, PlanningScene
from robocas_ms3.planning.skills.place import ContainerInterior, compute_overhang, sample_poses_above_container
from robocas_ms3.scenes.grasp_checks import is_gripper_clear


def solve_pick_cube(env, seed=None, debug=False, vis=False):
    """Solve PickCube-v1; ``debug`` shows the box from which the grasp is computed."""
    env.reset(seed=seed)
    planner = PandaArmMotionPlanningSolver(env, base_pose=env.unwrapped.agent.robot.pose, vis=vis)
    env = env.unwrapped

    # compute a grasp from above from the oriented bounding box of the cube
    obb = get_actor_obb(env.cube, vis=debug)
    approaching = np.array([0, 0, -1])
    target_closing = env.agent.tcp.pose.sp.to_transformation_matrix()[:3, 1]
    grasp_info = compute_grasp_info_by_obb(obb, approaching, target_closing, depth=0.025)
    grasp_pose = env.agent.build_grasp_pose(approaching, grasp_info["closing"], env.cube.pose.sp.p)

    # move above the cube, then down, close the gripper, and move the cube to the goal
    planner.move_to_pose_with_screw(grasp_pose * sapien.Pose([0, 0, -0.05]))
    planner.move_to_pose_with_screw(grasp_pose)
    planner.close_gripper()
    res = planner.move_to_pose_with_screw(sapien.Pose(env.goal_site.pose.sp.p, grasp_pose.q))
    planner.close()
    return res


def solve_pick(env, seed=None, debug=False, vis=False):
    """Solve RoboCASPick-v1 in a scene with a table; ``debug`` prints why poses were rejected."""
    env.reset(seed=seed)
    planner = PandaArmMotionPlanningSolver(env, base_pose=env.unwrapped.agent.robot.pose, vis=vis)
    env = env.unwrapped
    scene, slot, rise = PlanningScene(env), int(env.target_slot[0]), sapien.Pose([0, 0, 0.1])
    all_obstacles, other_obstacles = scene.obstacles_in_world(), scene.obstacles_in_world(exclude=slot)

    def reach_and_grasp(grasp_pose):
        # move to a pose 10 cm before the grasp without touching any object, then straight to the grasp
        planner.clear_collisions()
        planner.add_obstacles(all_obstacles)
        planner.move_to_pose_with_RRTConnect(grasp_pose * sapien.Pose([0, 0, -0.1]))
        planner.clear_collisions()
        planner.add_obstacles(other_obstacles)
        planner.move_to_pose_with_screw(grasp_pose)
        planner.move_to_pose_with_screw(rise * grasp_pose, dry_run=True)  # can the object be lifted from this grasp?

    grasp_pose = first_reachable(reach_and_grasp, ranked_grasps(env, scene, slot), debug)
    planner.close_gripper(t=10)
    planner.move_to_pose_with_screw(rise * grasp_pose)

    # the planner must move the grasped object without collisions, too
    held = AttachedBody(
        np.concatenate(env.object_assets[0][slot].hulls), inverse(scene.tcp_in_base) @ scene.object_in_base(slot)
    )
    planner.planner.attach(held)
    drops = ranked_drops(env, scene, slot, held, np.random.default_rng(seed))
    first_reachable(planner.move_to_pose_with_RRTConnect, drops, debug)
    planner.open_gripper(t=10)
    planner.planner.attach(None)
    res = planner.move_to_pose_with_RRTConnect(rise * grasp_pose)  # the object comes to rest during this motion
    planner.close()
    return res


def first_reachable(move, poses, debug):
    """Return the first of ``poses`` for which ``move`` finds a motion; raise PlanningError if there is none."""
    failure = PlanningError("example", "no_pose")
    for pose in poses:
        try:
            move(pose)
            return pose
        except PlanningError as error:
            failure = error
            if debug:
                print(error)
    raise failure


def ranked_grasps(env, scene, slot):
    """Return the annotated grasps of the target that touch no other object; firm, central and steep grasps first."""
    target, base = env.object_assets[0][slot], scene.arm_base_in_world
    notes, object_in_world = target.annotations, base @ scene.object_in_base(slot)
    candidates = filter_grasps(notes, object_in_world, base)
    points = transform_points(base, scene.points_in_base(exclude=slot))
    grasps_in_object = notes.grasps_tcp_in_object[candidates.index]
    margins = compute_grip_margins(grasps_in_object, candidates.widths, target.surface_points(SPACING))
    distance = np.linalg.norm(candidates.tcp_in_world[:, :3, 3] - object_in_world[:3, 3], axis=1)
    score = margins + np.exp(-distance / 0.03) - candidates.tcp_in_world[:, 2, 2]
    score[~is_gripper_clear(candidates.tcp_in_world, points)] = -np.inf
    order = np.argsort(-score, kind="stable")
    return [sapien.Pose(candidates.tcp_in_world[i]) for i in order if np.isfinite(score[i])]


def ranked_drops(env, scene, slot, held, rng):
    """Return poses of the TCP with the object above the basket; poses with little overhang, then steep poses first."""
    inner = env.model.basket.asset.inner
    inside = ContainerInterior(scene.basket_in_base, np.array(inner.min), np.array(inner.max))
    center = np.array([env.object_assets[0][slot].asset.center_of_mass])
    vertices, center = transform_points(held.object_in_tcp, held.vertices), transform_points(held.object_in_tcp, center)
    drops = sample_poses_above_container(rng, 200, inside, vertices, center[0])
    overhang = compute_overhang(drops, inside, vertices, margin=0.03)
    order = np.lexsort((drops[:, 2, 2], np.ceil(overhang / 0.015)))
    return [sapien.Pose(scene.arm_base_in_world @ drops[i]) for i in order]


SOLUTIONS = {"PickCube-v1": solve_pick_cube, "RoboCASPick-v1": solve_pick}


def main(
    env: Literal["PickCube-v1", "RoboCASPick-v1"] = "PickCube-v1",
    seed: int = 0,
    episodes: int = 10,
    image: Path | None = None,
    debug: bool = False,
    vis: bool = False,
) -> None:
    """Solve episodes of consecutive seeds.

    Args:
        env: environment to solve.
        seed: seed of the first episode, at least 0.
        episodes: number of episodes.
        image: file for an image of the last step, such as ``end.png``.
        debug: print why grasps and motions are rejected.
        vis: open ManiSkill's viewer, which needs a display.
    """
    if image is not None:
        if not cv2.haveImageWriter(str(image)):
            raise SystemExit(f"--image {image}: unknown image format, expected for example {image.with_suffix('.png')}")
        image.parent.mkdir(parents=True, exist_ok=True)
    no_renderer = dict(render_backend="none") if env == "RoboCASPick-v1" and not (image or vis) else {}
    environment = gym.make(env, obs_mode="state", control_mode="pd_joint_pos", sim_backend="cpu", **no_renderer)
    successes = 0
    for number in range(seed, seed + episodes):
        try:
            *_, info = SOLUTIONS[env](environment, seed=number, debug=debug, vis=vis)
            success = bool(info["success"][0])
            print(f"seed {number}: success {success}, {int(info['elapsed_steps'][0])} steps")
        except PlanningError as error:
            success = False
            print(f"seed {number}: {error}")
        successes += success
    print(f"{successes} of {episodes} episodes succeeded")
    if image and not cv2.imwrite(str(image), environment.unwrapped.render_rgb_array()[0].cpu().numpy()[..., ::-1]):
        raise SystemExit(f"--image {image}: the file cannot be written")
    environment.close()


if __name__ == "__main__":
    tyro.cli(main)
