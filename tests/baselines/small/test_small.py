"""`small`: samples of a dataset, training, policy, and refused datasets."""

import re
import shutil
import threading
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from pydantic import ValidationError
from small_sizes import TINY, VIEW
from synthetic_observations import observe, start
from training_runs import fit

from robocas_ms3.baselines.chunks import decode_chunk
from robocas_ms3.baselines.small import BASELINE, data
from robocas_ms3.baselines.small.config import CameraView, SmallConfig
from robocas_ms3.baselines.small.data import crop_image
from robocas_ms3.baselines.small.localization import CELL, NOWHERE, compute_cell_losses
from robocas_ms3.baselines.small.model import shift_images
from robocas_ms3.baselines.small.objects import SceneObjects
from robocas_ms3.baselines.training.session import merge_configs
from robocas_ms3.core.errors import DatasetError, TrainingError
from robocas_ms3.core.poses import to_wxyz
from robocas_ms3.core.strict_model import parse
from robocas_ms3.datasets.formats import open_source


def read(folder, split="train", **changes):
    return BASELINE.data(SmallConfig(**{**TINY, **changes}), folder, split, lambda done, total: None)


@pytest.fixture(scope="module")
def samples(folder):
    return read(folder)


def test_samples_are_learned_and_a_policy_sees_the_same(samples, folder):
    """The loss falls, and the policy executes the network's prediction for the sample of a step."""
    model, losses = fit(BASELINE, SmallConfig(**TINY), samples, 30)
    assert losses[-1] < 0.4 * losses[0]
    source = open_source(folder)
    episode, policy = source.episode(source.split("train")[0]), BASELINE.policy(model.config, samples.facts, model)
    arrays = episode.arrays
    for step in (0, 4):
        policy.reset([start()])
        seen = observe(
            embeddings=arrays["language_embedding"][None],
            images={name: episode.rgb(name, step)[None] for name in policy.spec.cameras},
            tcp_in_base=np.append(arrays["ee_pos"][step], np.roll(arrays["ee_orn"][step], 1))[None],
            gripper_width=arrays["gripper_width"].reshape(-1, 1)[step : step + 1],
        )
        with torch.inference_mode():
            chunk = model.act(samples.__getitems__([step]))[0]
        action = policy.act(seen)[0]
        assert action[:3] == pytest.approx(chunk[0, :3].numpy(), abs=1e-5)
        assert (action[6] > 0.5) == (chunk[0, 9] > 0.5)


def test_every_weight_is_learned(samples):
    """In bf16 too; parameters without a gradient would stall training on several GPUs."""
    torch.manual_seed(0)
    model = BASELINE.model(SmallConfig(**TINY), samples.facts)
    batch = samples.__getitems__(list(range(len(samples))))
    # One object at the position of the next key pose
    batch |= {"object_classes": torch.zeros(len(samples), 1), "object_texts": batch["text"][:, None]}
    batch |= {"object_heights": torch.full((len(samples), 1), 0.1)}
    batch |= {f"{camera}_object_pixels": batch[f"{camera}_key_pixel"][:, None] for camera in model.config.views}
    with torch.autocast("cpu", torch.bfloat16):
        loss = model(batch)["loss"]
    loss.backward()
    assert [name for name, weight in model.named_parameters() if weight.grad is None] == []
    assert all(torch.isfinite(weight.grad).all() for weight in model.parameters())
    for unproject in (*model.key_unprojectors.values(), *model.object_unprojectors.values()):
        assert unproject.offsets.weight.grad.any() and unproject.height[2].weight.grad.any()


def test_samples_are_those_of_the_dataset(samples, folder):
    source = open_source(folder)
    numbers = source.split("train")
    assert (samples.episodes, len(samples)) == (5, 35)
    arrays = source.episode(numbers[2]).arrays
    batch = samples.__getitems__([2 * 7 + 4])
    expected = crop_image(source.episode(numbers[2]).rgb("gripper_camera", 4), VIEW)
    assert np.array_equal(batch["gripper_camera"][0].numpy(), expected)
    assert batch["state"][0, :3].tolist() == pytest.approx(arrays["ee_pos"][4].tolist())
    assert batch["state"][0, 9].item() == pytest.approx(float(arrays["gripper_width"][4]) / 0.08)
    assert batch["text"][0].tolist() == arrays["language_embedding"].tolist()
    here = np.eye(4)
    here[:3, 3] = arrays["ee_pos"][4]
    turn = batch["state"][0, 3:9].numpy().astype(np.float64)
    here[:3, :3] = np.stack([turn[:3], turn[3:], np.cross(turn[:3], turn[3:])], axis=1)
    ahead, _ = decode_chunk(batch["chunk"][0].numpy(), here)
    assert np.allclose(ahead[0, :3, 3], arrays["ee_pos"][5], atol=1e-5)
    wxyz = to_wxyz(ahead[:1])[0, 3:]
    assert abs(wxyz @ np.roll(arrays["ee_orn"][5], 1)) == pytest.approx(1, abs=1e-5)


def test_arrays_are_read_by_one_thread(folder, monkeypatch):
    """NumPy reads headers with `ast`, which raised SystemError in threads of Python 3.11 (gh-106905)."""
    threads, load = set(), np.load
    monkeypatch.setattr(
        "numpy.load", lambda *args, **kwargs: threads.add(threading.get_ident()) or load(*args, **kwargs)
    )
    read(folder)
    assert threads == {threading.get_ident()}


def test_objects_get_instructions_that_name_them(folder, monkeypatch, caplog):
    """Without language, all instructions would be equal and have different labels."""

    def made(episode, arrays, poses, projections):
        nowhere = {name: np.zeros((len(poses), 2, 2), np.float32) for name in projections}
        return SceneObjects(len(poses), "apple", ["apple", "pear"], nowhere, np.zeros((2, 3)))

    read(folder)
    (line,) = caplog.messages  # the synthetic dataset has no layouts
    assert line.startswith(f"{folder}: no object poses in scene.json")
    caplog.clear()
    monkeypatch.setattr(data, "locate_objects", made)
    batches = [read(folder, "val", language=language).__getitems__([0]) for language in (True, False)]
    assert [batch["object_classes"].tolist() for batch in batches] == [[[0, -1]], [[-1, -1]]]
    assert [bool(batch["text"].any()) for batch in batches] == [True, False]
    assert not caplog.records


def test_images_are_cropped_and_scaled():
    image = np.zeros((48, 64, 3), np.uint8)
    image[24:, 32:] = 200
    view = CameraView(image_size=(64, 48), crop=(0.5, 0.5, 1.0, 1.0), size=(16, 16))
    assert (crop_image(image, view) == 200).all()
    assert crop_image(image, view).shape == (16, 16, 3)
    larger = np.repeat(np.repeat(image, 2, 0), 2, 1)
    assert (crop_image(larger, view) == 200).all()  # scaled to ``image_size`` first


def test_error_of_the_image_size_names_the_options_of_each_camera(folder):
    """The options are valid: the dataset is read with them."""
    views = {name: CameraView(image_size=(512, 384)) for name in TINY["views"]}
    with pytest.raises(DatasetError) as caught:
        read(folder, views=views)
    options = re.findall(r"--set views\.(\w+)\.image_size=\[(\d+),(\d+)\]", caught.value.fix)
    assert [name for name, *_ in options] == list(views)
    views = {name: CameraView(image_size=(int(width), int(height))) for name, width, height in options}
    assert len(read(folder, views=views)) > 0


def test_shifts_move_images_as_a_whole():
    image = torch.arange(6 * 8, dtype=torch.uint8).reshape(1, 6, 8, 1).repeat(2, 1, 1, 1)
    moved = shift_images(image, torch.tensor([[2, 0], [-1, 3]]))
    assert moved[0, :, 2:, 0].equal(image[0, :, :-2, 0]) and moved[0, :, 0].equal(image[0, :, 0])  # right
    assert moved[1, 3:, :-1, 0].equal(image[1, :-3, 1:, 0])  # down and left


def test_labels_move_with_the_shifted_image(samples, monkeypatch):
    torch.manual_seed(0)
    model = BASELINE.model(SmallConfig(**{**TINY, "shift": 16}), samples.facts).train()
    batch = samples.__getitems__([0] * 64)
    x, y = batch["base_camera_key_pixel"][0].long().tolist()
    batch["base_camera"] = torch.zeros_like(batch["base_camera"])
    batch["base_camera"][:, y, x] = 255
    seen, cells = [], []

    def encode(images, encode=model._encode_images):
        seen.append(images["base_camera"])
        return encode(images)

    def losses(logits, answers, columns):
        cells.append(answers)
        return compute_cell_losses(logits, answers, columns)

    monkeypatch.setattr(model, "_encode_images", encode)
    monkeypatch.setattr("robocas_ms3.baselines.small.model.compute_cell_losses", losses)
    model(batch)
    bright = seen[0][:, 0] > 0  # (64, 48, 64)
    for image, cell in zip(bright, cells[0][:, 0].tolist(), strict=True):
        rows, columns = (np.unique(where // CELL) for where in np.nonzero(image.numpy()))
        if cell != NOWHERE:  # outside of the image its edge is repeated
            assert cell in {row * (64 // CELL) + column for row in rows for column in columns}
    assert len({tuple(one) for one in cells[0].tolist()}) > 8


def test_images_are_requested_in_the_size_of_the_dataset(folder):
    """Rendering at half the size gives other images than scaling to half the size."""
    half = CameraView(image_size=(32, 24), size=(32, 32))
    views = {"base_camera": half, "gripper_camera": half}
    config, samples = SmallConfig(**{**TINY, "views": views}), read(folder, "val", views=views)
    policy = BASELINE.policy(config, samples.facts, BASELINE.model(config, samples.facts))
    assert (policy.spec.rate_hz, policy.spec.reference) == (5.0, "tcp")
    assert policy.spec.cameras == {"base_camera": (64, 48), "gripper_camera": (64, 48)}
    with pytest.raises(DatasetError, match="robocas convert --size 512 384"):
        read(folder, views={"base_camera": CameraView()})


def test_training_without_a_camera_and_language(folder):
    """`--set views.gripper_camera=null` removes a camera of the defaults."""
    changes = {"views": {"gripper_camera": None}, "language": False}
    merged = merge_configs(SmallConfig(**TINY).model_dump(mode="json"), changes)
    config = parse(SmallConfig, merged, TrainingError, where="small")
    assert list(config.views) == ["base_camera"]
    samples = BASELINE.data(config, folder, "val", lambda done, total: None)
    model = BASELINE.model(config, samples.facts)
    assert torch.isfinite(model(samples.__getitems__([0, 1]))["loss"])
    spec = BASELINE.policy(config, samples.facts, model).spec
    assert (spec.cameras, spec.language) == ({"base_camera": (64, 48)}, "none")


@pytest.mark.parametrize(
    ("model", "values"),
    [
        (SmallConfig, {**TINY, "heads": 3, "width": 32}),
        (SmallConfig, {**TINY, "views": {}}),
        (CameraView, {"size": (100, 96)}),
        (CameraView, {"crop": (0.5, 0, 0.4, 1)}),
        (CameraView, {"crop": (0, 0, 1.2, 1)}),
        (CameraView, {"image_size": (0, 0)}),
    ],
)
def test_invalid_configurations(model, values):
    with pytest.raises(ValidationError):
        model(**values)


def _move_camera(folder):
    path = sorted(folder.glob("episode_*/base_camera/true_cam_pose_wrt_arm_base.npy"))[2]
    pose = np.load(path)
    pose[0, 3] += 0.002
    np.save(path, pose)


def _widen_camera(folder):
    path = sorted(folder.glob("episode_*/gripper_camera/intrinsic.npy"))[2]
    np.save(path, np.load(path) * [0.9, 0.9, 1, 1])


@pytest.mark.parametrize(
    ("spoil", "message"),
    [
        (lambda folder: next(folder.glob("*/base_camera/rgb/0003.png")).unlink(), "0003.png"),
        (_move_camera, r"base_camera, mount: .*expected \[\["),
        (_widen_camera, r"gripper_camera, intrinsic: .*expected \["),
    ],
)
def test_unsuitable_datasets_are_refused(folder, tmp_path, spoil, message):
    copy = shutil.copytree(folder, tmp_path / "copy")
    spoil(copy)
    with pytest.raises(DatasetError, match=message):
        read(copy)


def test_images_must_fit_into_memory(folder, monkeypatch):
    """Each process of `accelerate launch` keeps all images."""
    fits = 1.5 * 35 * 2 * 3 * VIEW.size[0] * VIEW.size[1] / 0.9  # once, and not twice
    monkeypatch.setattr(data.psutil, "virtual_memory", lambda: SimpleNamespace(available=fits))
    read(folder)
    monkeypatch.setenv("LOCAL_WORLD_SIZE", "2")
    with pytest.raises(DatasetError) as caught:
        read(folder)
    assert caught.value.where == folder


def test_without_unprojection_a_camera_may_move(folder, tmp_path):
    copy = shutil.copytree(folder, tmp_path / "copy")
    _move_camera(copy)
    samples = read(copy, unproject=False)
    model = BASELINE.model(SmallConfig(**TINY, unproject=False), samples.facts)
    batch = samples.__getitems__([0, 1, 2])
    assert torch.isfinite(model(batch)["loss"])
    assert model.act(batch).shape == (3, 3, 10)
    assert "calibration" not in samples.facts  # else a run with another one could not start from this one
