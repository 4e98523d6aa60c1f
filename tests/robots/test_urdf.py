from __future__ import annotations

import os
import subprocess
import sys
import xml.etree.ElementTree as ET
from importlib.machinery import ModuleSpec
from pathlib import Path

import numpy as np
import pytest
from robot_checks import link_poses, numbers

import robocas_ms3.robots
from robocas_ms3.core.errors import RobocasError
from robocas_ms3.planning.collision import CollisionChecker
from robocas_ms3.robots.description import MOBILE_PANDA
from robocas_ms3.robots.urdf import make_robot_files

REST = dict(zip(MOBILE_PANDA.arm_joints, MOBILE_PANDA.arm_rest, strict=True))
EVALUATION = dict(zip(MOBILE_PANDA.arm_joints, MOBILE_PANDA.arm_evaluation_start, strict=True))


def python(code: str, **env: str) -> subprocess.Popen:
    env = {**os.environ, **env}
    return subprocess.Popen(
        [sys.executable, "-c", code], env=env, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    )


def output(process: subprocess.Popen) -> str:
    out, err = process.communicate(timeout=120)
    assert process.returncode == 0, err
    return out.strip()


def test_heights_above_the_floor():
    poses = link_poses(make_robot_files().urdf, REST)
    assert poses["base_link"][2, 3] == pytest.approx(0.26)
    assert poses["panda_link0"][:3, 3] == pytest.approx([0, 0, 0.49])
    # The evaluation start has the TCP 0.29 m above the 0.61 m table, which determines the base link's height of 0.26 m.
    assert link_poses(make_robot_files().urdf, EVALUATION)["panda_hand_tcp"][2, 3] - 0.61 == pytest.approx(
        0.287, abs=2e-3
    )


@pytest.mark.parametrize(("extension", "distance"), [(0.03, 0.1334), (0.0, 0.1034)])
def test_tcp_is_in_front_of_the_hand_and_not_turned(extension, distance):
    poses = link_poses(make_robot_files(extension).urdf, REST)
    tcp_in_hand = np.linalg.inv(poses["panda_hand"]) @ poses["panda_hand_tcp"]
    expected = np.eye(4)
    expected[2, 3] = distance
    assert tcp_in_hand == pytest.approx(expected, abs=1e-9)


def collision_boxes(urdf: Path, link: str) -> list[tuple[np.ndarray, np.ndarray]]:
    element = ET.parse(urdf).getroot().find(f"link[@name='{link}']")
    return [
        (numbers(x.find("geometry/box").get("size")), numbers(x.find("origin").get("xyz")))
        for x in element.iterfind("collision")
        if x.find("geometry/box") is not None
    ]


def test_finger_tips_meet_in_the_middle_and_reach_8_mm_beyond_the_tcp():
    urdf = make_robot_files().urdf
    poses = link_poses(urdf, {})
    tips = {link: collision_boxes(urdf, link)[-1] for link in MOBILE_PANDA.finger_links}
    for (size, centre), side in zip(tips.values(), (1, -1), strict=True):
        assert size == pytest.approx([0.018, 0.004, 0.055])
        assert side * centre[1] - size[1] / 2 == pytest.approx(0)  # inner face at the finger's y = 0
    finger_in_tcp = np.linalg.inv(poses["panda_hand_tcp"]) @ poses["panda_leftfinger"]
    assert finger_in_tcp[:2, 3] == pytest.approx([0, 0], abs=1e-9)  # closed: both at the TCP's y = 0
    size, centre = tips["panda_leftfinger"]
    assert finger_in_tcp[2, 3] + centre[2] + size[2] / 2 == pytest.approx(0.008)
    assert len(collision_boxes(make_robot_files(0.0).urdf, "panda_leftfinger")) == 4  # stock: no tip


def test_base_body_stays_off_the_floor_and_the_pedestal_carries_the_arm():
    boxes = collision_boxes(make_robot_files().urdf, "base_link")
    assert min(centre[2] - size[2] / 2 for size, centre in boxes) + 0.26 == pytest.approx(0.01)
    pedestal = [(size, centre) for size, centre in boxes if size == pytest.approx([0.25, 0.2, 0.2])]
    assert len(pedestal) == 1
    assert pedestal[0][1] == pytest.approx([0, 0, 0.13])


def test_arm_urdf_is_the_same_arm_rooted_at_its_base():
    files = make_robot_files()
    whole = link_poses(files.urdf, EVALUATION)
    arm = link_poses(files.arm_urdf, EVALUATION)
    for link in ("panda_hand_tcp", "panda_leftfinger", "base_link"):
        assert arm[link] == pytest.approx(np.linalg.inv(whole["panda_link0"]) @ whole[link], abs=1e-9)
    children = {joint.find("child").get("link") for joint in ET.parse(files.arm_urdf).getroot().iterfind("joint")}
    assert "panda_link0" not in children


def test_srdf_reports_true_self_collisions_only():
    files = make_robot_files()
    world = CollisionChecker(files.arm_urdf, files.arm_srdf, MOBILE_PANDA)
    reaching = (0, 0.6, 0, -1.5, 0, 2.1, 0.78)
    for qpos in (MOBILE_PANDA.arm_rest, MOBILE_PANDA.arm_evaluation_start, reaching):
        for width in (0.0, 0.08):
            assert world.find_collisions(np.array(qpos), width) == []
    into_base = world.find_collisions(np.array((0, 1.7, 0, -1.6, 0, 1.5, 0)), 0.08)
    assert {"base_link", "panda_hand"} <= set(into_base)
    folded = world.find_collisions(np.array((0, -1, 0, -3.05, 0, 0, 0)), 0.08)
    assert "base_link" not in folded
    assert len(folded) >= 2  # the hand on the shoulder


def test_files_are_made_once_and_again_when_damaged(tmp_path, monkeypatch):
    monkeypatch.setenv("ROBOCAS_CACHE", str(tmp_path))
    files = make_robot_files()
    assert files.folder.parent == tmp_path / "robots"
    stamp = files.urdf.stat().st_mtime_ns
    assert make_robot_files() == files
    assert files.urdf.stat().st_mtime_ns == stamp
    mesh = files.folder / "visual" / "hand.glb"
    mesh.unlink()
    assert make_robot_files() == files
    assert mesh.is_file()
    assert [path.name for path in files.folder.parent.iterdir()] == [files.folder.name]  # nothing left behind
    assert make_robot_files(0.0).folder != files.folder
    for path in ET.parse(files.urdf).getroot().iter("mesh"):
        assert (files.folder / path.get("filename")).is_file()


def test_two_processes_generate_the_files_once(tmp_path):
    code = "from robocas_ms3.robots.urdf import make_robot_files; print(make_robot_files().urdf)"
    both = [python(code, ROBOCAS_CACHE=str(tmp_path)) for _ in range(2)]
    first, second = (output(process) for process in both)
    assert first == second
    assert Path(first).is_file()
    assert len(list((tmp_path / "robots").iterdir())) == 1


def test_an_unwritable_cache_is_an_error(tmp_path, monkeypatch):
    (tmp_path / "file").write_text("")
    monkeypatch.setenv("ROBOCAS_CACHE", str(tmp_path / "file"))
    with pytest.raises(RobocasError) as caught:
        make_robot_files()
    assert str(caught.value.where).startswith(str(tmp_path / "file"))


@pytest.mark.parametrize("urdf", [None, "<robot/>", '<robot><joint name="panda_hand_tcp_joint"/></robot>'])
def test_mani_skill_without_the_panda_is_an_error(tmp_path, monkeypatch, urdf):
    monkeypatch.setenv("ROBOCAS_CACHE", str(tmp_path / "cache"))
    spec = ModuleSpec("mani_skill", None, is_package=True)
    monkeypatch.setattr("importlib.util.find_spec", lambda name: spec if urdf else None)
    if urdf:
        spec.submodule_search_locations.append(str(tmp_path))
        folder = tmp_path / "assets" / "robots" / "panda"
        folder.mkdir(parents=True)
        (folder / "panda_v2.urdf").write_text(urdf)
    with pytest.raises(RobocasError) as caught:
        make_robot_files()
    assert "mani_skill" in caught.value.fix


def test_imports_write_nothing_and_the_urdf_needs_no_sapien(tmp_path):
    code = (
        "import sys, robocas_ms3.robots.urdf; print('sapien' in sys.modules, 'mani_skill' in sys.modules);"
        "import robocas_ms3.robots.agent"
    )
    cache = tmp_path / "cache"
    assert output(python(code, ROBOCAS_CACHE=str(cache))).splitlines()[0] == "False False"
    assert not cache.exists()


def test_the_package_contains_no_meshes():
    folder = Path(robocas_ms3.robots.__file__).parent
    assert {path.suffix for path in folder.rglob("*") if path.is_file()} <= {".py", ".pyc"}
