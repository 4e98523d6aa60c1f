"""Train a small policy on a dataset for 20 steps: images and robot states of two steps in, a chunk of four actions out.

python examples/04_train_loader.py DATASET
"""

import sys
import time

import torch
from torch import nn
from torch.utils.data import DataLoader, WeightedRandomSampler

from robocas_ms3.datasets import RoboCASDataset, SampleOptions

OBSERVED, CHUNK, STEPS = 2, 4, 20  # observed steps, predicted actions, training steps


class Policy(nn.Module):
    """Convolutional network for the images, followed by a network that predicts the actions."""

    def __init__(self) -> None:
        super().__init__()
        layers = []
        for inputs, outputs in ((2 * OBSERVED * 3, 16), (16, 32), (32, 64)):
            layers += [nn.Conv2d(inputs, outputs, 5, stride=3), nn.GroupNorm(4, outputs), nn.ReLU()]
        self.encoder = nn.Sequential(*layers, nn.AdaptiveAvgPool2d(3), nn.Flatten())
        self.head = nn.Sequential(nn.Linear(64 * 9 + 8 * OBSERVED, 128), nn.ReLU(), nn.Linear(128, CHUNK * 7))

    def forward(self, batch):
        features = self.encoder(batch["rgb"].flatten(1, 3).float() / 255)  # from (B, H, C, 3, h, w)
        return self.head(torch.cat([features, batch["state"].flatten(1)], dim=1)).unflatten(1, (CHUNK, 7))


def loss(policy: Policy, batch) -> torch.Tensor:
    """Return the mean absolute error of the actions; actions after the end of an episode do not count."""
    chunk, is_real = batch["action"][:, -CHUNK:], batch["action_mask"][:, -CHUNK:]
    return (policy(batch) - chunk).abs()[is_real].mean()


if __name__ == "__main__":
    torch.manual_seed(0)
    data = RoboCASDataset(
        sys.argv[1],
        SampleOptions(
            split="train",
            observation_horizon=OBSERVED,
            action_horizon=CHUNK,
            size=(160, 128),
            state=("ee_pos", "ee_orn", "gripper_width"),
            subgoals=True,
            normalize=True,
        ),
    )
    print(f"{len(data.episodes)} episodes, {len(data)} samples, first: {data[0]['instruction']}")
    # draw each kind of sub-goal equally often
    sampler = WeightedRandomSampler(data.sampling_weights().tolist(), 8 * STEPS)
    loader = DataLoader(data, batch_size=8, sampler=sampler, num_workers=2)
    policy = Policy()
    optimizer = torch.optim.AdamW(policy.parameters(), lr=1e-3)
    start, losses = time.perf_counter(), []
    for batch in loader:
        value = loss(policy, batch)
        optimizer.zero_grad()
        value.backward()
        optimizer.step()
        losses.append(value.item())
    rate = 8 * STEPS / (time.perf_counter() - start)
    first, last = sum(losses[:5]) / 5, sum(losses[-5:]) / 5
    print(f"{STEPS} steps, {rate:.0f} samples per second, loss {first:.3f} -> {last:.3f}")
