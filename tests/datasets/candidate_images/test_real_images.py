"""Decisions rendered by the cameras of ManiSkill: objects are where the camera poses say."""

import gymnasium as gym
import numpy as np
import pytest
from recorded_candidates import make_records

from robocas_ms3.datasets.candidate_images.images_file import CandidateImages, images_path
from robocas_ms3.datasets.candidate_images.render import render_candidates
from robocas_ms3.datasets.candidate_images.settings import CandidateImageSettings
from robocas_ms3.demos.candidates.candidates_file import CandidateFile, write_candidates
from robocas_ms3.demos.recordings.environment import read_recorded_env
from robocas_ms3.demos.recordings.trajectory_file import Recording

ENV_ID = "robocas_ms3:RoboCASPick-v1"
ENV_INFO = {"env_id": ENV_ID, "env_kwargs": {"control_mode": "pd_joint_pos", "obs_mode": "none"}}
SEED = 11

pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def candidates(tmp_path_factory, needs_renderer):
    """A decision after the reset, and one after a motion of the arm towards the objects."""
    env = gym.make(ENV_ID, obs_mode="none", control_mode="pd_joint_pos")
    base = env.unwrapped
    env.reset(seed=SEED)
    states = [base.get_state_dict()]
    arm = base.agent.robot.get_qpos()[0, 3:10].numpy() + [0, 0.3, 0, 0.3, 0, 0, 0]
    for _ in range(8):
        env.step(np.append(arm, 1).astype(np.float32))
    states.append(base.get_state_dict())
    recording = Recording(
        episode_id=0,
        seed=SEED,
        reset_options={},
        control_mode="pd_joint_pos",
        control_steps=1,
        instruction=base.get_language_instruction()[0],
        subgoals=[],
        is_intervention=False,
        has_action_noise=False,
        actions=np.zeros((1, 8), np.float32),
        states={
            kind: {name: np.concatenate([state[kind][name].numpy() for state in states]) for name in states[0][kind]}
            for kind in ("actors", "articulations")
        },
        robot=read_recorded_env(ENV_INFO, "here").robot(),
    )
    names = [asset.asset.id for asset in base.object_assets[0]]
    records = make_records(recording, (0, 1), int(base.target_slot[0]), names)
    env.close()
    path = tmp_path_factory.mktemp("candidates") / "candidates.h5"
    write_candidates(path, records, ENV_INFO, {})
    return path


def test_objects_are_at_their_projected_positions(candidates):
    """The centre of an object is at most 8 cm behind the surface that a camera sees there."""
    size = (160, 120)
    render_candidates(CandidateImageSettings(candidates, size=size))
    file, images = CandidateFile(candidates), CandidateImages(images_path(candidates))
    assert images.size == size
    seen, hidden = dict.fromkeys(images.cameras, 0), 0
    for row in range(len(file)):
        for camera in images.cameras:
            pose, (fx, fy, cx, cy) = images.camera_in_base(row, camera), images.intrinsic(row, camera)
            depth = images.depth(row, camera) / 1000
            for centre in file.decisions["object_in_base"][row][file.decisions["present"][row], :3]:
                x, y, z = np.linalg.inv(pose)[:3] @ [*centre, 1]
                column, line = (int(np.floor(v)) for v in (fx * x / z + cx, fy * y / z + cy))
                if z > 0.1 and 0 <= column < size[0] and 0 <= line < size[1]:
                    near = -0.03 < z - depth[line, column] < 0.08
                    seen[camera] += near
                    hidden += not near
    assert seen["base_camera"] >= 4
    assert seen["static_camera"] >= 4
    assert hidden <= 0.3 * sum(seen.values())
