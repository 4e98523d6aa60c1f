"""`small`: what it sees of a dataset, that it learns that by heart, and what does not suit it."""

import json
import shutil
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from made_up_runs import assert_same, stop_at, train
from pydantic import ValidationError
from small_sizes import TINY, VIEW

from robocas_ms3.baselines.chunks import decode
from robocas_ms3.baselines.small import BASELINE, data
from robocas_ms3.baselines.small.config import SmallConfig, View
from robocas_ms3.baselines.small.data import crop_image
from robocas_ms3.baselines.small.model import shifted
from robocas_ms3.baselines.small.pointing import CELL, NOWHERE, pointing_losses
from robocas_ms3.baselines.small.standing import Standing
from robocas_ms3.baselines.training.session import merge_configs
from robocas_ms3.core.errors import DatasetError, TrainingError
from robocas_ms3.core.poses import to_wxyz
from robocas_ms3.core.strict import parse
from robocas_ms3.datasets.formats import open_source
from robocas_ms3.evaluation.policy import EpisodeSpec, Observations


@pytest.fixture(scope="module")
def samples(folder):
    return BASELINE.data(SmallConfig(**TINY), folder, "train", lambda done, of: None)


@pytest.fixture(scope="module")
def learned(samples):
    """A tiny network that has seen five episodes 250 times."""
    torch.manual_seed(0)
    config = SmallConfig(**TINY)
    model = BASELINE.model(config, samples.facts)
    optimizer = torch.optim.AdamW(model.parameters(), lr=3e-3)
    schedule = torch.optim.lr_scheduler.CosineAnnealingLR(optimizer, 250)
    batch = samples.__getitems__(list(range(len(samples))))
    for _ in range(250):
        optimizer.zero_grad()
        model(batch)["loss"].backward()
        torch.nn.utils.clip_grad_norm_(model.parameters(), 1.0)
        optimizer.step()
        schedule.step()
    return model.eval()


def test_five_episodes_are_learned(learned, samples):
    """To 5 mm of motion, which is some 20 mm a step, and to every command."""
    batch = samples.__getitems__(list(range(len(samples))))
    with torch.inference_mode():
        found = learned(batch)
        chunk = learned.act(batch)
    assert found["loss"] < 0.25
    assert found["first_mm"] < 5
    assert ((chunk[..., 9] > 0.5) == (batch["chunk"][..., 9] > 0.5)).float().mean() >= 0.95


def test_every_weight_is_learned(samples):
    """In bf16 as well; weights without a gradient would keep several GPUs waiting for them."""
    torch.manual_seed(0)
    model = BASELINE.model(SmallConfig(**TINY), samples.facts)
    batch = samples.__getitems__(list(range(len(samples))))
    batch |= {
        "kinds": torch.zeros(len(samples), 1),
        "asked": batch["words"][:, None],
    }  # one at the next key
    batch |= {"heights": torch.full((len(samples), 1), 0.1)}
    batch |= {f"{camera}_places": batch[f"{camera}_place"][:, None] for camera in model.config.views}
    with torch.autocast("cpu", torch.bfloat16):
        loss = model(batch)["loss"]
    loss.backward()
    assert [name for name, weight in model.named_parameters() if weight.grad is None] == []
    assert all(torch.isfinite(weight.grad).all() for weight in model.parameters())
    for lift in (*model.lifts.values(), *model.stands.values()):
        assert lift.offsets.weight.grad.any() and lift.height[2].weight.grad.any()


def test_a_policy_goes_where_it_was_shown(learned, samples, folder):
    policy = BASELINE.policy(learned.config, samples.facts, learned)
    assert (policy.spec.rate_hz, policy.spec.reference) == (5.0, "tcp")
    assert policy.spec.cameras == {"base_camera": (64, 48), "gripper_camera": (64, 48)}
    source = open_source(folder)
    number = source.split("train")[0]
    episode, arrays = source.episode(number), source.episode(number).arrays
    poses = np.concatenate([arrays["ee_pos"], np.roll(arrays["ee_orn"], 1, axis=1)], axis=1)
    policy.reset([EpisodeSpec(0, 0, "pick", "", "", "builtin", 0, "")])
    for step in range(3):
        action = policy.act(observed(episode, arrays, poses, step))[0]
        assert np.abs(action[:3] - arrays["rel_pos"][step]).max() < 0.008
        assert (action[6] > 0.5) == bool(arrays["gripper_status"][step + 1])


def observed(episode, arrays, poses, step):
    return Observations(
        envs=np.array([0]),
        instructions=[""],
        embeddings=arrays["language_embedding"][None],
        images={name: episode.rgb(name, step)[None] for name in ("base_camera", "gripper_camera")},
        depths={},
        robot={
            "qpos": np.zeros((1, 12), np.float32),
            "tcp_in_base": poses[step : step + 1].astype(np.float32),
            "gripper_width": arrays["gripper_width"].reshape(-1, 1)[step : step + 1],
        },
        state=None,
    )


def test_samples_are_the_datasets(samples, folder):
    source = open_source(folder)
    numbers = source.split("train")
    assert (samples.episodes, len(samples)) == (5, 35)
    arrays = source.episode(numbers[2]).arrays
    batch = samples.__getitems__([2 * 7 + 4])
    expected = crop_image(source.episode(numbers[2]).rgb("gripper_camera", 4), VIEW)
    assert np.array_equal(batch["gripper_camera"][0].numpy(), expected)
    assert batch["state"][0, :3].tolist() == pytest.approx(arrays["ee_pos"][4].tolist())
    assert batch["state"][0, 9].item() == pytest.approx(float(arrays["gripper_width"][4]) / 0.08)
    assert batch["words"][0].tolist() == arrays["language_embedding"].tolist()
    here = np.eye(4)
    here[:3, 3] = arrays["ee_pos"][4]
    turn = batch["state"][0, 3:9].numpy().astype(np.float64)
    here[:3, :3] = np.stack([turn[:3], turn[3:], np.cross(turn[:3], turn[3:])], axis=1)
    ahead, _ = decode(batch["chunk"][0].numpy(), here)
    assert np.allclose(ahead[0, :3, 3], arrays["ee_pos"][5], atol=1e-5)
    wxyz = to_wxyz(ahead[:1])[0, 3:]
    assert abs(wxyz @ np.roll(arrays["ee_orn"][5], 1)) == pytest.approx(1, abs=1e-5)


def test_without_language_nothing_is_asked_for(folder, monkeypatch, caplog):
    """All questions would be the same, and have other answers."""

    def made(episode, arrays, poses, looks):
        nowhere = {name: np.zeros((len(poses), 2, 2), np.float32) for name in looks}
        return Standing(len(poses), "apple", ["apple", "pear"], nowhere, np.zeros((2, 3)))

    monkeypatch.setattr(data, "standing", made)
    kinds = [
        BASELINE.data(SmallConfig(**TINY, language=language), folder, "val", lambda done, of: None)
        .__getitems__([0])["kinds"]
        .tolist()
        for language in (True, False)
    ]
    assert kinds == [[[0, -1]], [[-1, -1]]]
    assert not caplog.records


def test_it_is_said_where_nothing_can_be_asked_for(folder, caplog):
    """The made-up dataset knows no scenes."""
    for split in ("train", "val"):  # once
        BASELINE.data(SmallConfig(**TINY), folder, split, lambda done, of: None)
    (said,) = caplog.messages
    assert said.startswith(f"{folder}: no scene.json tells where objects stood")


def test_without_language_words_say_nothing(folder):
    config = SmallConfig(**TINY, language=False)
    samples = BASELINE.data(config, folder, "val", lambda done, of: None)
    assert not samples.__getitems__([0])["words"].any()
    assert BASELINE.policy(config, samples.facts, BASELINE.model(config, samples.facts)).spec.language == "none"


def test_a_part_is_cut_and_scaled():
    picture = np.zeros((48, 64, 3), np.uint8)
    picture[24:, 32:] = 200
    view = View(rendered=(64, 48), part=(0.5, 0.5, 1.0, 1.0), size=(16, 16))
    assert (crop_image(picture, view) == 200).all()
    assert crop_image(picture, view).shape == (16, 16, 3)
    larger = np.repeat(np.repeat(picture, 2, 0), 2, 1)
    assert (crop_image(larger, view) == 200).all()  # scaled to what is rendered first


def test_shifts_move_pictures_as_a_whole():
    picture = torch.arange(6 * 8, dtype=torch.uint8).reshape(1, 6, 8, 1).repeat(2, 1, 1, 1)
    moved = shifted(picture, torch.tensor([[2, 0], [-1, 3]]))
    assert moved[0, :, 2:, 0].equal(picture[0, :, :-2, 0]) and moved[0, :, 0].equal(picture[0, :, 0])  # right
    assert moved[1, 3:, :-1, 0].equal(picture[1, :-3, 1:, 0])  # down and left


def test_it_is_shown_pictures_of_the_size_it_learned_by(folder):
    """Those of half the size are not the same, rendered or scaled."""
    half = View(rendered=(32, 24), size=(32, 32))
    config = SmallConfig(**{**TINY, "views": {"base_camera": half, "gripper_camera": half}})
    samples = BASELINE.data(config, folder, "val", lambda done, of: None)
    policy = BASELINE.policy(config, samples.facts, BASELINE.model(config, samples.facts))
    assert policy.spec.cameras == {"base_camera": (64, 48), "gripper_camera": (64, 48)}


@pytest.mark.parametrize(("chunk", "play", "looks"), [(8, 3, 3), (4, 7, 4)])
def test_it_looks_when_it_predicts(folder, monkeypatch, chunk, play, looks):
    """After as many steps as it follows a chunk for, which are no more than a chunk has."""
    config = SmallConfig(**{**TINY, "chunk": chunk, "play": play})
    facts = BASELINE.data(config, folder, "val", lambda done, of: None).facts
    policy = BASELINE.policy(config, facts, BASELINE.model(config, facts))
    assert policy.spec.look_every == looks
    episode = open_source(folder).episode(open_source(folder).split("train")[0])
    poses = np.concatenate([episode.arrays["ee_pos"], np.roll(episode.arrays["ee_orn"], 1, axis=1)], axis=1)
    predicted, predict = [], policy._predict
    monkeypatch.setattr(policy, "_predict", lambda *seen: (predicted.append(1), predict(*seen))[1])
    policy.reset([EpisodeSpec(0, 0, "pick", "", "", "builtin", 0, "")])
    for step in range(7):
        predicted.clear()
        policy.act(observed(episode, episode.arrays, poses, step))
        assert len(predicted) == (step % looks == 0)


def test_what_is_to_be_found_moves_with_a_picture(samples, monkeypatch):
    """A picture's answers are asked for where the place's pixel is once it is shifted."""
    torch.manual_seed(0)
    model = BASELINE.model(SmallConfig(**{**TINY, "shift": 16}), samples.facts).train()
    batch = samples.__getitems__([0] * 64)
    x, y = batch["base_camera_place"][0].long().tolist()
    batch["base_camera"] = torch.zeros_like(batch["base_camera"])
    batch["base_camera"][:, y, x] = 255
    seen, cells = [], []

    def look(pictures):
        seen.append(pictures["base_camera"])
        return looking(pictures)

    def losses(logits, answers, columns):
        cells.append(answers)
        return pointing_losses(logits, answers, columns)

    looking = model._look
    monkeypatch.setattr(model, "_look", look)
    monkeypatch.setattr("robocas_ms3.baselines.small.model.pointing_losses", losses)
    model(batch)
    bright = seen[0][:, 0] > 0  # (64, 48, 64)
    for picture, cell in zip(bright, cells[0][:, 0].tolist(), strict=True):
        rows, columns = (np.unique(where // CELL) for where in np.nonzero(picture.numpy()))
        if cell == NOWHERE:
            continue  # out of the picture; what shows is the edge going on
        assert cell in {row * (64 // CELL) + column for row in rows for column in columns}
    assert len({tuple(one) for one in cells[0].tolist()}) > 8


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"heads": 3, "width": 32}, "multiple of heads"),
        ({"views": {}}, "views of a camera"),
    ],
)
def test_networks_that_there_are_not(change, message):
    with pytest.raises(ValidationError, match=message):
        SmallConfig(**{**TINY, **change})


def test_a_camera_may_be_left_out(folder):
    """As `--set views.gripper_camera=null` says it, above the defaults."""
    told = merge_configs(SmallConfig(**TINY).model_dump(mode="json"), {"views": {"gripper_camera": None}})
    config = parse(SmallConfig, told, TrainingError, where="small")
    assert list(config.views) == ["base_camera"]
    samples = BASELINE.data(config, folder, "val", lambda done, of: None)
    model = BASELINE.model(config, samples.facts)
    assert torch.isfinite(model(samples.__getitems__([0, 1]))["loss"])
    assert BASELINE.policy(config, samples.facts, model).spec.cameras == {"base_camera": (64, 48)}


@pytest.mark.parametrize(
    "change", [{"size": (100, 96)}, {"part": (0.5, 0, 0.4, 1)}, {"part": (0, 0, 1.2, 1)}, {"rendered": (0, 0)}]
)
def test_views_that_there_are_not(change):
    with pytest.raises(ValidationError):
        View(**change)


def _say(folder, **settings):
    path = folder / "conversion.json"
    path.write_text(json.dumps({**json.loads(path.read_text()), **settings}))


def _not_a_number(folder):
    path = sorted(folder.glob("episode_*/episode_info.npz"))[1]
    arrays = dict(np.load(path))
    arrays["ee_pos"][2, 1] = np.nan
    np.savez(path, **arrays)


@pytest.mark.parametrize(
    ("spoil", "message"),
    [
        (lambda folder: _say(folder, embeddings=False), "small needs embeddings.*--set language=false"),
        (lambda folder: _say(folder, cameras=["base_camera"]), "--set views.CAMERA=null"),
        (lambda folder: _say(folder, cameras=[]), "found none"),
        (lambda folder: _say(folder, rate_hz=10.0), "expected 5 Hz, found 10 Hz.*--set rate_hz=10"),
        (_not_a_number, "not a number"),
        (lambda folder: next(folder.glob("*/base_camera/rgb/0003.png")).unlink(), "0003.png"),
    ],
)
def test_data_that_does_not_suit_it(folder, tmp_path, spoil, message):
    copy = shutil.copytree(folder, tmp_path / "copy")
    spoil(copy)
    with pytest.raises(DatasetError, match=message):
        BASELINE.data(SmallConfig(**TINY), copy, "train", lambda done, of: None)


def test_a_camera_that_looks_elsewhere_in_one_episode(folder, tmp_path):
    """How it looks is learned once; without that it may look as it likes."""
    copy = shutil.copytree(folder, tmp_path / "copy")
    path = sorted(copy.glob("episode_*/base_camera/cam_pos_wrt_arm_base.npy"))[2]
    moved = np.load(path)
    moved[0, 3] += 0.002
    np.save(path, moved)
    with pytest.raises(DatasetError, match=r"base_camera, mount: a camera looks another way.*expected \[\["):
        BASELINE.data(SmallConfig(**TINY), copy, "train", lambda done, of: None)
    config = SmallConfig(**TINY, lift=False)
    samples = BASELINE.data(config, copy, "train", lambda done, of: None)
    model = BASELINE.model(config, samples.facts)
    batch = samples.__getitems__([0, 1, 2])
    assert torch.isfinite(model(batch)["loss"])
    assert model.act(batch).shape == (3, 3, 10)
    assert "calibration" not in samples.facts  # with which a run could not begin where they are others


def test_a_camera_that_looks_wider_in_one_episode(folder, tmp_path):
    copy = shutil.copytree(folder, tmp_path / "copy")
    path = sorted(copy.glob("episode_*/gripper_camera/intrinsic.npy"))[2]
    np.save(path, np.load(path) * [0.9, 0.9, 1, 1])
    with pytest.raises(DatasetError, match=r"gripper_camera, intrinsic: a camera looks another way.*expected \["):
        BASELINE.data(SmallConfig(**TINY), copy, "train", lambda done, of: None)


def test_more_pictures_than_memory_holds(folder, monkeypatch):
    monkeypatch.setattr(data.psutil, "virtual_memory", lambda: SimpleNamespace(available=1e5))
    with pytest.raises(DatasetError, match="more pictures than memory holds.*robocas split"):
        BASELINE.data(SmallConfig(**TINY), folder, "train", lambda done, of: None)


def test_each_process_keeps_all_pictures(folder, monkeypatch):
    fits = 1.5 * 35 * 2 * 3 * VIEW.size[0] * VIEW.size[1] / 0.9  # once, and not twice
    monkeypatch.setattr(data.psutil, "virtual_memory", lambda: SimpleNamespace(available=fits))
    BASELINE.data(SmallConfig(**TINY), folder, "train", lambda done, of: None)
    monkeypatch.setenv("LOCAL_WORLD_SIZE", "2")
    with pytest.raises(DatasetError, match="more pictures than memory holds"):
        BASELINE.data(SmallConfig(**TINY), folder, "train", lambda done, of: None)


@pytest.mark.parametrize("precision", ["fp32", "bf16"])
def test_it_goes_on_to_the_bit(folder, tmp_path, precision):
    """With what is random in it: shifts, light and dropout."""
    few = {"steps": 6, "batch_size": 8, "save_every": 2, "check_every": 3, "log_every": 1, "precision": precision}
    changes = {**SmallConfig(**{**TINY, "dropout": 0.1, "shift": 3, "brightness": 0.2}).model_dump(), "train": few}
    train("small", folder, tmp_path / "whole", changes)
    with pytest.raises(RuntimeError):
        said = stop_at(5, RuntimeError("gone"))
        train("small", folder, tmp_path / "again", changes, progress=said)
    train("small", folder, tmp_path / "again")
    assert_same(tmp_path / "whole", tmp_path / "again")


def test_pictures_that_are_too_small(folder):
    with pytest.raises(DatasetError, match="robocas convert --size 512 384"):
        BASELINE.data(SmallConfig(), folder, "train", lambda done, of: None)
