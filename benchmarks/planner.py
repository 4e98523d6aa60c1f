"""Measure the motion planner: inverse kinematics, joint-space plans, straight lines, reachability; print JSON.

python benchmarks/planner.py --scenes 5 --plans 20

Each scene is a table with 15 boxes as a point cloud with a spacing of 5 mm, about 50,000 points. The arm moves to poses
above the table, in which the gripper points down, and from there straight down or up. JSON keys:
  points                      median number of points of a scene
  trajectory_seconds_median   median duration of the planned motions in seconds
  set_scene                   building the collision model of a scene
  ik                          inverse kinematics of one pose
  plan_to_pose                a joint-space plan to a pose
  plan_straight               a straight line of the TCP
  reachability_256            inverse kinematics of a batch of 256 poses
    median_ms, p95_ms         median and 95th percentile of the wall-clock time in ms
    outcomes                  "ok" or reason of the failure -> number of calls
"""

from __future__ import annotations

import argparse
import json
import time
from collections import Counter
from collections.abc import Callable

import numpy as np

from robocas_ms3 import PlanningError
from robocas_ms3.planning.kinematics import ArmChain, InverseKinematics
from robocas_ms3.planning.protocol import Array
from robocas_ms3.planning.rrt_connect import RRTConnectPlanner
from robocas_ms3.robots.description import MOBILE_PANDA
from robocas_ms3.robots.urdf import make_robot_files

SPACING = 0.005


def sample_box_surface(center: Array, size: Array, yaw: float) -> Array:
    """Return points (P, 3) on the six faces of a box, in m."""
    faces = []
    for axis in range(3):
        u, v = (i for i in range(3) if i != axis)
        steps = [np.linspace(-s / 2, s / 2, int(np.ceil(s / SPACING)) + 1) for s in (size[u], size[v])]
        a, b = (grid.ravel() for grid in np.meshgrid(*steps))
        for side in (-0.5, 0.5):
            face = np.zeros((len(a), 3))
            face[:, u], face[:, v], face[:, axis] = a, b, side * size[axis]
            faces.append(face)
    c, s = np.cos(yaw), np.sin(yaw)
    return np.concatenate(faces) @ np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]]).T + center


def make_table_cloud(rng: np.random.Generator) -> Array:
    """Return the point cloud of a table top 4 cm below the arm's base with 15 boxes on it."""
    pieces = [sample_box_surface(np.array([0.6, 0, -0.05]), np.array([0.5, 0.7, 0.02]), 0.0)]
    for _ in range(15):
        size = rng.uniform(0.03, 0.1, 3)
        x, y = rng.uniform((0.4, -0.3), (0.8, 0.3))
        pieces.append(sample_box_surface(np.array([x, y, -0.04 + size[2] / 2]), size, rng.uniform(-3, 3)))
    return np.concatenate(pieces)


def sample_top_down_pose(rng: np.random.Generator) -> Array:
    """Return a random pose of the TCP over the table, pointing down."""
    yaw = rng.uniform(-np.pi, np.pi)
    c, s = np.cos(yaw), np.sin(yaw)
    pose = np.eye(4)
    pose[:3, :3] = [[c, s, 0], [s, -c, 0], [0, 0, -1]]
    pose[:3, 3] = rng.uniform((0.4, -0.35, 0.06), (0.7, 0.35, 0.3))
    return pose


class Stopwatch:
    """Milliseconds and outcomes by name."""

    def __init__(self) -> None:
        self.milliseconds: dict[str, list[float]] = {}
        self.outcomes: dict[str, Counter[str]] = {}

    def run(self, name: str, call: Callable, *args, **kwargs):
        """Measure a call; a planning failure counts as an outcome and returns None."""
        start = time.perf_counter()
        try:
            result, outcome = call(*args, **kwargs), "ok"
        except PlanningError as error:
            result, outcome = None, error.reason
        self.milliseconds.setdefault(name, []).append((time.perf_counter() - start) * 1e3)
        self.outcomes.setdefault(name, Counter())[outcome] += 1
        return result

    def summary(self) -> dict:
        """Return median and 95th percentile in ms, and outcomes, by name."""
        return {
            name: {
                "median_ms": round(float(np.median(values)), 2),
                "p95_ms": round(float(np.percentile(values, 95)), 2),
                "outcomes": dict(self.outcomes[name]),
            }
            for name, values in self.milliseconds.items()
        }


def main() -> None:
    """Run the benchmark."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--scenes", type=int, default=5)
    parser.add_argument("--plans", type=int, default=20, help="plans in each scene")
    parser.add_argument("--seed", type=int, default=0)
    options = parser.parse_args()

    files, watch, points, seconds = make_robot_files(), Stopwatch(), [], []
    planner = RRTConnectPlanner(files.arm_urdf, files.arm_srdf, robot=MOBILE_PANDA, dt=0.05)
    reachability = InverseKinematics(ArmChain(files.arm_urdf, MOBILE_PANDA))
    for scene in range(options.seed, options.seed + options.scenes):
        rng = np.random.default_rng(scene)
        cloud = make_table_cloud(rng)
        points.append(len(cloud))
        planner.seed(scene)
        watch.run("set_scene", planner.set_scene, cloud)
        here = np.array(MOBILE_PANDA.arm_rest)
        for _ in range(options.plans):
            goal = sample_top_down_pose(rng)
            watch.run("ik", planner.ik, goal, here)
            trajectory = watch.run("plan_to_pose", planner.plan_to_pose, here, goal, stage="reach")
            if trajectory is None:
                continue
            here = trajectory.qpos[-1]
            seconds.append(trajectory.duration)
            lift = goal.copy()
            lift[2, 3] += rng.choice((-0.05, 0.1))
            watch.run("plan_straight", planner.plan_straight, here, lift, stage="straight")
        poses = np.array([sample_top_down_pose(rng) for _ in range(256)])
        watch.run("reachability_256", reachability.nearest_solutions, poses, np.array(MOBILE_PANDA.arm_rest))
    result = {
        "points": int(np.median(points)),
        "trajectory_seconds_median": round(float(np.median(seconds)), 2),
        **watch.summary(),
    }
    print(json.dumps(result, indent=2))


if __name__ == "__main__":
    main()
