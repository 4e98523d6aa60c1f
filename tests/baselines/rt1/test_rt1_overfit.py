"""A small rt1 learns five episodes by heart: from pictures on disk to actions that a policy gives."""

import numpy as np
import torch
from rt1_sizes import SIZES

from robocas_ms3.baselines.rt1 import BASELINE
from robocas_ms3.baselines.rt1.config import RT1Config
from robocas_ms3.datasets.formats import open_source
from robocas_ms3.evaluation.policy import EpisodeSpec, Observations

SMALL = {
    **SIZES,
    "picture": (48, 36),
    "crop_height": 32,
    "frames": 2,
    "image_width": 0.1,
    "token_width": 64,
    "width": 64,
    "dropout": 0.0,
    "drop_connect": 0.0,
}
STEPS = 110


def test_five_episodes_are_learned(folder):
    """At least 95 % of action tokens, as policies act; then the policy does what was shown, half a bin off."""
    config = RT1Config(**SMALL)
    samples = BASELINE.data(config, folder, "train", lambda done, of: None)
    torch.manual_seed(0)
    model = BASELINE.model(config, samples.facts)
    batch = samples.__getitems__(list(range(len(samples))))
    optimizer = torch.optim.AdamW(model.parameters(), lr=8e-3)
    schedule = torch.optim.lr_scheduler.CosineAnnealingLR(optimizer, STEPS)
    model.train()
    for _ in range(STEPS):
        loss = model(batch)["loss"]
        optimizer.zero_grad()
        loss.backward()
        torch.nn.utils.clip_grad_norm_(model.parameters(), config.train.clip_norm)
        optimizer.step()
        schedule.step()
    with torch.inference_mode():
        found = model.eval()(batch)
    assert found["action_accuracy"] >= 0.95
    assert found["terminate_accuracy"] >= 0.95
    right = [played(BASELINE.policy(config, samples.facts, model), folder, place) for place in range(5)]
    assert np.mean(right) >= 0.95


def played(policy, folder, place):
    """The share of an episode's numbers that a policy gives back, shown its pictures one after the other."""
    source = open_source(folder)
    number = source.split("train")[place]
    episode = source.episode(number)
    arrays = episode.read(["rel_pos", "gripper_status", "language_embedding"])
    policy.reset([EpisodeSpec(3, 0, "pick", "", "", "builtin", 0, "")])
    given = []
    for step in range(source.lengths[number] - 1):
        nothing = np.zeros((1, 12), np.float32)
        shown = Observations(
            envs=np.array([3]),
            instructions=[""],
            embeddings=arrays["language_embedding"][None],
            images={name: episode.rgb(name, step)[None] for name in policy.spec.cameras},
            depths={},
            robot={"qpos": nothing, "tcp_in_base": nothing[:, :7], "gripper_width": nothing[:, :1]},
            state=None,
        )
        given.append(policy.act(shown)[0])
    low, high = (np.array(source.action_space()["relative_position"][end]) for end in (0, 1))
    wanted = np.clip(arrays["rel_pos"][:-1], low, high)
    near = np.abs(np.array(given)[:, :3] - wanted) <= 0.51 * (high - low) / 256
    told = (np.array(given)[:, 6:] > 0.5) == (arrays["gripper_status"].reshape(-1, 1)[1:] > 0.5)
    return np.concatenate([near, told], axis=1).mean()
