"""Decisions on the page and on the contact sheet."""

from __future__ import annotations

import json
import shutil

import cv2
import numpy as np
import pytest
from recorded_candidates import PER_DECISION, write_recorded_candidates
from synthetic import write_trajectory
from synthetic_candidates import write_episodes

from robocas_ms3.cli.main import run
from robocas_ms3.core.errors import DatasetError
from robocas_ms3.datasets.candidate_images.images_file import images_path
from robocas_ms3.viewer.decisions.content import DecisionContent
from robocas_ms3.viewer.decisions.decision_source import DecisionSource, choose_view
from robocas_ms3.viewer.decisions.outcomes import COLOURS
from robocas_ms3.viewer.decisions.sheet import draw_decision, select_rows, write_sheet
from robocas_ms3.viewer.source import open_content

CAMERAS = ["base_camera", "gripper_camera", "static_camera"]


def test_outcomes_of_made_up_candidates(plain):
    # of ten moves every fourth is infeasible, every fourth fails, and every fourth helps
    expected = ["helped", "success", "failed", "infeasible"] * 2 + ["helped", "success"]
    assert plain.outcomes[plain.file.rows_of(0)].tolist() == expected
    # a grasp, release or pull can't help
    assert set(plain.outcomes[plain.file.rows_of(1)]) == {"success", "failed", "infeasible"}


def test_table_has_a_row_per_decision(source):
    index = DecisionContent(source).index()
    json.dumps(index)
    assert (index["cameras"], index["depth"], index["note"]) == (CAMERAS, True, "")
    rows = index["episodes"]
    assert [row["n"] for row in rows] == list(range(8))
    assert [row["task"] for row in rows[:4]] == ["move", "grasp", "release", "pull"]
    assert {row["steps"] for row in rows} == {PER_DECISION}
    assert [row["seed"] for row in rows] == [3] * 4 + [4] * 4
    assert all(row["success"] for row in rows)


def test_decision_lists_candidates_and_views(source):
    shown = DecisionContent(source).episode(0)
    json.dumps(shown, allow_nan=False)
    assert [view["name"] for view in shown["views"]] == [*CAMERAS, "top_view"]
    assert shown["best_view"] in CAMERAS
    assert [len(view["candidates"]) for view in shown["views"]] == [PER_DECISION] * 4
    first, failed = shown["candidates"][0], shown["candidates"][2]
    assert (first["chosen"], first["outcome"], first["primitive"]) == (True, "helped", "push")
    assert first["obstacles"] == [4, 2]
    assert first["benefit"] > 0
    assert (failed["outcome"], failed["failure"]) == ("failed", "grasp: slipped")
    with pytest.raises(DatasetError):
        DecisionContent(source).episode(8)


def test_without_images_there_is_a_plot_from_above(plain):
    content = DecisionContent(plain)
    index = content.index()
    assert (index["cameras"], index["depth"]) == ([], False)
    assert "robocas render-candidates" in index["note"]
    (view,) = content.episode(3)["views"]
    assert view["name"] == "top_view"
    assert all(view["candidates"])
    with pytest.raises(DatasetError):
        content.rgb(0, "base_camera", 0)


def test_plot_from_above_has_the_basket(tmp_path):
    source = DecisionSource(write_episodes(tmp_path / "candidates.h5", seeds=(3,)))
    row = int(np.flatnonzero(np.isfinite(source.file.decisions["basket_in_base"]).all(axis=1))[0])
    (basket,) = [thing for thing in source.views(row)[-1].objects if thing.name == "basket"]
    width, height = np.ptp(basket.outline, axis=0)
    assert min(width, height) > 20  # pixels


def test_command_tells_that_images_are_missing(plain_file, tmp_path, capsys):
    assert run(["view", str(plain_file), "--sheet", str(tmp_path / "sheet.png"), "--decisions", "1"]) == 0
    assert "robocas render-candidates" in capsys.readouterr().out


def test_images_of_other_decisions_are_not_shown(file_with_images, tmp_path):
    trajectory = write_trajectory(tmp_path / "trajectory.h5", seeds=(7,))
    other = write_recorded_candidates(tmp_path / "candidates.h5", trajectory, steps=(0,))
    images = shutil.copy(images_path(file_with_images), images_path(other))
    index = open_content(other).index()
    assert index["cameras"] == []
    assert "render-candidates CANDIDATES --overwrite" in index["note"]
    with pytest.raises(DatasetError):
        open_content(other, images=images)


def test_images_of_a_decision(source):
    content = DecisionContent(source)
    decoded = cv2.imdecode(np.frombuffer(content.rgb(2, "base_camera", 0).data, np.uint8), cv2.IMREAD_COLOR)
    assert decoded.shape[:2] == content.depth(2, "base_camera", 0).shape == (48, 64)
    with pytest.raises(DatasetError):
        content.rgb(2, "side_camera", 0)
    with pytest.raises(DatasetError):
        content.rgb(2, "base_camera", 1)


def test_chosen_view_shows_most_candidates(source):
    for row in range(len(source)):
        views = source.views(row)
        assert choose_view(views).visible >= 0.8 * max(view.visible for view in views[:-1])


def test_sheet_has_every_kind(plain):
    kinds = plain.file.decisions["kind"]
    assert select_rows(plain, 100) == list(range(8))
    assert sorted(kinds[select_rows(plain, 4)]) == ["grasp", "move", "pull", "release"]
    assert len(select_rows(plain, 3)) == 3


@pytest.mark.parametrize("name", ["plain", "source"])
@pytest.mark.parametrize("suffix", [".png", ".jpg"])
def test_sheet_is_an_image(request, tmp_path, name, suffix):
    path = tmp_path / f"sheet{suffix}"
    assert write_sheet(request.getfixturevalue(name), path, count=5) == [0, 1, 2, 3, 6]
    assert cv2.imread(str(path)).shape == (60 + 2 * (360 + 48 + 8), 4 * 488 + 8, 3)


def test_candidates_are_drawn_in_the_colour_of_their_outcome(plain):
    """The chosen push helped: its arrow is on top, so the middle of its shaft has the colour."""
    (view,) = plain.views(0)
    left, top, width, _ = view.region
    middle = (view.candidates[0][0].pixels.mean(axis=0) - (left, top)) * 480 / width
    panel = np.asarray(draw_decision(plain, 0))
    column, row = middle.astype(int)
    near = panel[row - 1 : row + 2, column - 1 : column + 2].reshape(-1, 3).astype(int)
    assert np.abs(near - COLOURS["helped"]).sum(axis=1).min() < 60


@pytest.mark.parametrize(
    ("suffix", "camera"), [(".gif", None), (".png", "side_camera")], ids=["unknown format", "unknown camera"]
)
def test_invalid_sheet_is_an_error(source, tmp_path, suffix, camera):
    with pytest.raises(DatasetError):
        write_sheet(source, tmp_path / f"sheet{suffix}", camera=camera)
    assert list(tmp_path.iterdir()) == []


def test_sheet_command(file_with_images, tmp_path, capsys):
    out = tmp_path / "sheet.png"
    words = ["view", str(file_with_images), "--sheet", str(out)]
    assert run([*words, "--decisions", "2", "--camera", "top_view"]) == 0
    assert capsys.readouterr().out == f"wrote {out}: 2 decisions\n"
    assert run([*words, "--decisions", "0"]) == 2
    assert run(["view", str(file_with_images.with_name("missing.h5")), "--sheet", str(out)]) == 2


def test_images_file_can_be_elsewhere(plain_file, file_with_images, tmp_path):
    images = file_with_images.with_name("candidates_images.h5")
    assert open_content(plain_file, images=images).index()["cameras"] == CAMERAS
    with pytest.raises(DatasetError):
        open_content(plain_file, images=tmp_path / "missing.h5")


def test_static_page(file_with_images, tmp_path, capsys):
    out = tmp_path / "page"
    assert run(["view", str(file_with_images), "--static", str(out), "--episodes", "1", "5"]) == 0
    assert capsys.readouterr().out == f"wrote {out / 'index.html'}: 2 decisions\n"
    assert sorted(path.name for path in (out / "data").iterdir()) == ["episode_1.js", "episode_5.js", "index.js"]
    assert {path.name for path in (out / "images" / "5").iterdir()} == set(CAMERAS)
    image = cv2.imread(str(out / "images" / "5" / "base_camera" / "rgb" / "0.jpg"))
    assert image.shape == (48, 64, 3)
    assert run(["view", str(file_with_images), "--static", str(out), "--overwrite", "--episodes", "8"]) == 2
