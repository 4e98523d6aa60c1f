"""Dataset that a baseline can memorize."""

from pathlib import Path

import pytest
from synthetic import RayCaster, stub_embeddings, write_trajectory

from robocas_ms3.datasets.conversion.convert import convert
from robocas_ms3.datasets.conversion.settings import ConversionSettings


def synthetic_dataset(folder: Path) -> Path:
    """Write six episodes of seven steps with 64 x 48 images and stub embeddings; five are for training."""
    trajectory = write_trajectory(folder / "F.h5", seeds=range(3, 9))
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("robocas_ms3.datasets.conversion.convert.embed_texts", stub_embeddings)
        convert(ConversionSettings(trajectory, folder / "dataset", video=False, open_renderer=RayCaster))
    return folder / "dataset"
