import gymnasium as gym
import pytest
import sapien
import torch

from robocas_ms3.tasks import renderer


def test_nothing_is_kept_where_nothing_is_rendered(monkeypatch):
    monkeypatch.setattr(renderer, "_kept", [])
    monkeypatch.setattr(renderer, "can_render", lambda device: False)
    renderer.keep_renderer(sapien.Device("cpu"))
    renderer.keep_renderer(None)  # render_backend="none"
    assert renderer._kept == []


@pytest.mark.slow
def test_one_stays_from_one_environment_to_the_next_which_sees_the_same(needs_renderer):
    seen = []
    for seed in (1, 0, 1):
        env = gym.make(
            "RoboCASPick-v1", obs_mode="rgb", sim_backend="physx_cpu", sensor_configs={"width": 32, "height": 24}
        )
        seen.append(env.reset(seed=seed)[0]["sensor_data"]["base_camera"]["rgb"])
        env.close()
        assert len(renderer._kept) == 1
    assert torch.equal(seen[0], seen[2])
    assert not torch.equal(seen[0], seen[1])
