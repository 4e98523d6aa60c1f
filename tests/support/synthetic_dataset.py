"""A dataset that baselines can learn by heart."""

from pathlib import Path

import pytest
from synthetic import RayCaster, stub_embeddings, write_trajectory

from robocas_ms3.datasets.conversion.convert import convert
from robocas_ms3.datasets.conversion.settings import ConversionSettings


def synthetic_dataset(folder: Path) -> Path:
    """Six episodes of seven steps, 64 x 48 images, made-up embeddings; five are to train on."""
    trajectory = write_trajectory(folder / "F.h5", seeds=range(3, 9))
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("robocas_ms3.datasets.conversion.convert.embed_texts", stub_embeddings)
        convert(ConversionSettings(trajectory, folder / "dataset", video=False, open_renderer=RayCaster))
    return folder / "dataset"
