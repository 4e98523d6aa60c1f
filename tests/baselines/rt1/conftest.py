"""Small network and batch of rt1."""

import pytest
import torch
from rt1_sizes import SIZES, settle

from robocas_ms3.baselines.rt1 import BASELINE
from robocas_ms3.baselines.rt1.config import RT1Config


@pytest.fixture
def facts():
    """Return the facts of a dataset of 64 x 48 images."""
    cameras = {"base_camera": [64, 48], "gripper_camera": [64, 48]}
    return {"rate_hz": 5.0, "cameras": cameras, "action_low": [-0.1] * 6, "action_high": [0.1] * 6}


@pytest.fixture
def config():
    return RT1Config(**SIZES)


@pytest.fixture
def model(config, facts, batch):
    """Return a network whose output depends on images and language; initial weights hardly do."""
    torch.manual_seed(0)
    made = BASELINE.model(config, facts)
    with torch.no_grad():
        for encoder in made.encoders:
            for film in [*encoder.films, encoder.film]:
                film.linear.weight.normal_(0, 0.3)
        made.transformer.head.weight.normal_(0, 1)
        settle(made, batch)
    return made


@pytest.fixture
def batch():
    """Return two samples of six frames; the first four frames of the first sample are padding."""
    torch.manual_seed(1)
    mask = torch.ones(2, 6, dtype=torch.bool)
    mask[0, :4] = False
    over = torch.zeros(2, 6, dtype=torch.bool)
    over[1, 5] = True
    return {
        "rgb": torch.randint(0, 256, (2, 6, 2, 3, 48, 64), dtype=torch.uint8),
        "language": torch.nn.functional.normalize(torch.randn(2, 384), dim=1),
        "action": torch.cat([torch.rand(2, 6, 6) * 0.2 - 0.1, torch.randint(0, 2, (2, 6, 1))], dim=-1),
        "mask": mask,
        "terminate": over,
    }
