"""What bodies do on a GPU, on tensors that stand for its buffers."""

from __future__ import annotations

from types import SimpleNamespace

import pytest
import torch

from robocas_ms3.tasks.bodies import BODY, Bodies

ENVS, ACTORS, JOINTS = 3, 2, 4


class Buffer:
    def __init__(self, *shape: int) -> None:
        self.values = torch.arange(float(torch.tensor(shape).prod())).reshape(shape)

    def torch(self) -> torch.Tensor:
        return self.values


@pytest.fixture
def bodies() -> Bodies:
    """Two actors and a robot in each of three envs, whose bodies lie in the buffer in a mixed order."""
    made = Bodies.__new__(Bodies)
    made._px = SimpleNamespace(cuda_rigid_body_data=Buffer(20, BODY), cuda_articulation_qvel=Buffer(5, 6))
    offsets = torch.tensor([[0.0, 0, 0], [10, 0, 0], [0, 10, 0]])
    made._scene = SimpleNamespace(gpu_sim_enabled=True, parallel_in_single_scene=True, scene_offsets=offsets)
    made._actors = [SimpleNamespace(name="one"), SimpleNamespace(name="two")]
    robot = SimpleNamespace(max_dof=JOINTS, _data_index=torch.tensor([4, 0, 2]))
    robot.qpos, robot.qvel = torch.rand(ENVS, JOINTS), torch.rand(ENVS, JOINTS)
    made._articulations = [robot]
    made._objects = slice(0, ACTORS)
    made._rows = torch.tensor([[5, 7, 0], [19, 3, 1], [8, 6, 2]])
    return made


def test_actors_are_put_into_their_envs_and_no_others_move(bodies):
    buffer = bodies._px.cuda_rigid_body_data.values
    before, poses = buffer.clone(), torch.rand(2, ACTORS, 7)
    bodies.put_objects(torch.tensor([2, 0]), poses)
    read = bodies.of_actors(bodies.read())
    assert torch.allclose(read[[2, 0], :, :7], poses, atol=1e-5)  # where they are asked for, whatever a scene's offset
    assert torch.allclose(buffer[[8, 6], 1], poses[0, :, 1] + 10)  # the third env stands 10 m aside
    others = [row for row in range(20) if row not in (5, 7, 8, 6)]
    assert torch.equal(buffer[others], before[others])
    assert torch.equal(buffer[:, 7:], before[:, 7:])


def test_some_envs_are_stopped_and_no_others(bodies):
    buffer, joints = bodies._px.cuda_rigid_body_data.values, bodies._px.cuda_articulation_qvel.values
    before, joints_before = buffer.clone(), joints.clone()
    bodies.stop(torch.tensor([1]))
    assert not buffer[[19, 3, 1], 7:].any()
    assert torch.equal(buffer[:, :7], before[:, :7])
    others = [row for row in range(20) if row not in (19, 3, 1)]
    assert torch.equal(buffer[others], before[others])
    assert not joints[0, :JOINTS].any()
    assert torch.equal(joints[0, JOINTS:], joints_before[0, JOINTS:])
    assert torch.equal(joints[1:], joints_before[1:])
