"""Loads a dataset with LeRobot and trains on it for two steps; run by check_lerobot.sh in LeRobot's own environment.

python check_lerobot.py DATASET
"""

import sys
import time
from fractions import Fraction
from importlib.metadata import version
from pathlib import Path

import av
import torch
from lerobot.configs.types import FeatureType
from lerobot.datasets.factory import resolve_delta_timestamps
from lerobot.datasets.lerobot_dataset import LeRobotDataset
from lerobot.datasets.utils import dataset_to_policy_features
from lerobot.policies.act.configuration_act import ACTConfig
from lerobot.policies.diffusion.configuration_diffusion import DiffusionConfig
from lerobot.policies.factory import get_policy_class, make_pre_post_processors

STEPS = 2
# No pretrained weights: nothing is downloaded. Small, since this is about the data.
POLICIES = {
    "act": lambda **features: ACTConfig(
        **features, device="cpu", pretrained_backbone_weights=None, chunk_size=8, n_action_steps=8, dim_model=128
    ),
    "diffusion": lambda **features: DiffusionConfig(
        **features, device="cpu", crop_shape=None, down_dims=(64, 128), horizon=8, n_action_steps=4
    ),
}


def main(root: Path) -> None:
    """Do it all; whatever LeRobot refuses raises."""
    versions = {name: version(name) for name in ("lerobot", "torch", "torchvision", "datasets", "av", "pyarrow")}
    say(f"versions: {versions}")
    begun = time.perf_counter()
    dataset = load(root)
    say(f"loaded in {time.perf_counter() - begun:.1f} s: {dataset.num_episodes} episodes, {len(dataset)} frames")
    say(f"{dataset.fps} fps, cameras {dataset.meta.camera_keys}")
    index(dataset)
    iterate(dataset)
    depth(root, dataset)
    for name in POLICIES:
        train(root, name)
    say("LeRobot takes this dataset")


def load(root: Path, **options) -> LeRobotDataset:
    """Open the dataset as LeRobot does, with the video reader that needs nothing of the machine."""
    return LeRobotDataset(f"robocas/{root.name}", root=root, video_backend="pyav", **options)


def index(dataset: LeRobotDataset) -> None:
    """Frames at the beginning, in the middle and at the end of every episode."""
    for row in dataset.meta.episodes:
        first, last = row["dataset_from_index"], row["dataset_to_index"] - 1
        for number in (first, (first + last) // 2, last):
            item = dataset[number]
            assert item["index"] == number
            assert item["episode_index"] == row["episode_index"]
            assert item["task"] == row["tasks"][0]
    for key, value in item.items():
        say(f"  {key}: {f'{tuple(value.shape)} {value.dtype}' if isinstance(value, torch.Tensor) else repr(value)}")
    for key, stats in dataset.meta.stats.items():
        assert {"min", "max", "mean", "std", "count", "q01", "q99"} <= set(stats), key
    say(f"indexed {3 * len(dataset.meta.episodes)} frames; statistics of {len(dataset.meta.stats)} features")


def iterate(dataset: LeRobotDataset) -> None:
    """Every frame, once, in a shuffled loader with a worker."""
    begun, seen = time.perf_counter(), []
    for batch in torch.utils.data.DataLoader(dataset, batch_size=16, shuffle=True, num_workers=1):
        seen += batch["index"].tolist()
        for key in dataset.meta.camera_keys:
            assert 0 <= batch[key].min() <= batch[key].max() <= 1
    assert sorted(seen) == list(range(len(dataset)))
    seconds = time.perf_counter() - begun
    say(f"iterated: {len(seen)} frames in {seconds:.1f} s, {len(seen) / seconds:.0f} a second")


def depth(root: Path, dataset: LeRobotDataset) -> None:
    """A 16-bit frame of depth beside an item, as docs/lerobot.md shows it, with PyAV alone."""
    item = dataset[len(dataset) // 2]
    row = dataset.meta.episodes[int(item["episode_index"])]
    cameras = [
        key.removeprefix("depth/").split("/")[0] for key in row if key.endswith("/file_index") and "depth" in key
    ]
    for camera in cameras:
        place = f"chunk-{row[f'depth/{camera}/chunk_index']:03d}/file-{row[f'depth/{camera}/file_index']:03d}.mkv"
        seconds = row[f"depth/{camera}/from_timestamp"] + float(item["timestamp"])
        with av.open(str(root / "depth" / camera / place)) as video:
            stream = video.streams.video[0]
            video.seek(int(Fraction(seconds) / stream.time_base), stream=stream)
            frames = (frame for frame in video.decode(stream) if frame.time > seconds - 0.5 / dataset.fps)
            picture = next(frames).to_ndarray(format="gray16le")
        say(f"  depth of {camera}: {picture.shape} {picture.dtype}, {picture.min()} to {picture.max()} mm")


def train(root: Path, name: str) -> None:
    """Two steps of a policy on the features that LeRobot itself picks."""
    meta = load(root).meta
    features = dataset_to_policy_features(meta.features)
    outputs = {key: feature for key, feature in features.items() if feature.type is FeatureType.ACTION}
    inputs = {key: feature for key, feature in features.items() if key not in outputs}
    config = POLICIES[name](input_features=inputs, output_features=outputs)
    policy = get_policy_class(name)(config)
    prepare, _ = make_pre_post_processors(config, dataset_stats=meta.stats)
    dataset = load(root, delta_timestamps=resolve_delta_timestamps(config, meta))
    loader = torch.utils.data.DataLoader(dataset, batch_size=4, shuffle=True)
    optimizer = torch.optim.AdamW(policy.parameters(), lr=1e-4)
    policy.train()
    for step, batch in zip(range(STEPS), loader, strict=False):
        begun = time.perf_counter()
        loss, _ = policy.forward(prepare(batch))
        assert torch.isfinite(loss)
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
        say(f"{name}, step {step + 1}: loss {loss.item():.3f}, {time.perf_counter() - begun:.1f} s")


def say(text: str) -> None:
    """A line of the log."""
    print(text, flush=True)


if __name__ == "__main__":
    main(Path(sys.argv[1]))
