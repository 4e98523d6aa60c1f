"""``robocas validate candidates.h5``: a valid file has no violation, and each damage is one."""

# pyright: reportAttributeAccessIssue=false, reportIndexIssue=false
import json

import h5py
import numpy as np
import pytest
from synthetic_candidates import ENV_INFO, SETTINGS, make_record, write_episodes

from robocas_ms3.cli.main import run
from robocas_ms3.datasets.checks.candidates import validate_candidates
from robocas_ms3.datasets.formats import CANDIDATES, detect_format
from robocas_ms3.demos.candidates.candidates_file import merge_candidates, write_candidates


def test_valid_file_has_no_violation(tmp_path, capsys):
    path = write_episodes(tmp_path / "c.h5")
    assert run(["validate", str(path)]) == 0
    assert "2 episodes, 4 decisions, 24 candidates, valid" in capsys.readouterr().out
    assert run(["validate", str(path), "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["valid"]


def test_padded_and_empty_files_are_valid(tmp_path):
    write_candidates(tmp_path / "empty.h5", [], ENV_INFO, SETTINGS)
    assert validate_candidates(tmp_path / "empty.h5").violations == []
    parts = [write_episodes(tmp_path / f"{slots}.h5", seeds=(slots,), slots=slots) for slots in (3, 5)]
    merge_candidates(parts, tmp_path / "c.h5")
    assert validate_candidates(tmp_path / "c.h5").violations == []


DAMAGES = [  # field, row, value
    ("decisions/seed", 0, -1),
    ("decisions/decision", 1, 2),
    ("decisions/step", 1, -3),
    ("decisions/kind", 0, b"x"),
    ("decisions/instruction", 0, b""),
    ("decisions/target_slot", 0, 7),
    ("decisions/object_id", (0, 1), b""),
    ("decisions/object_in_base", (0, 1, 3), 2.0),
    ("decisions/basket_in_base", (0, 1), np.nan),
    ("decisions/tcp_in_base", 0, np.nan),
    ("decisions/qpos", (0, 3), np.inf),
    ("decisions/gripper_width", 0, -0.1),
    ("decisions/held_slot", 0, 5),
    ("decisions/opening", 0, 3.0),
    ("decisions/hidden_fraction", (0, 2), 1.5),
    ("decisions/obstacles", (0, 2), -1),
    ("decisions/free_grasps", (0, 2), -1),
    ("candidates/primitive", 0, b"x"),
    ("candidates/source", 0, b"x"),
    ("candidates/slot", 0, -1),
    ("candidates/end_in_base", (1, 3), 3.0),
    ("candidates/chosen", 1, True),
    ("candidates/seconds", 0, np.nan),
    ("candidates/object_after_in_base", (0, 1, 0), np.nan),
    ("candidates/displacement", (0, 1), 0.5),
    ("candidates/disturbed", 0, -1),
    ("candidates/obstacles", (0, 2), -1),
    ("candidates/moves_to_grasp", 0, -2),
    ("states/actors/object_1", (0, 3), 2.0),
    ("states/articulations/robocas_mobile_panda", (0, 20), np.inf),
]


@pytest.mark.parametrize(("field", "row", "value"), DAMAGES)
def test_damaged_values_are_found(tmp_path, capsys, field, row, value):
    path = write_episodes(tmp_path / "c.h5")
    with h5py.File(path, "r+") as file:
        file[field][row] = value
    assert run(["validate", str(path)]) == 1
    assert field in capsys.readouterr().out


@pytest.mark.parametrize("success", [True, False])
def test_success_agrees_with_feasibility_and_failure(tmp_path, success):
    record = make_record(3, 0)
    record.candidates[0] |= {"success": success, "feasible": False, "failure": "" if not success else "x: y"}
    write_candidates(tmp_path / "c.h5", [record], ENV_INFO, SETTINGS)
    found = {violation.key for violation in validate_candidates(tmp_path / "c.h5").violations}
    assert "candidates/failure, row 0" in found
    assert ("candidates/success, row 0" in found) == success


def test_unknown_start_is_a_violation(tmp_path):
    records = [make_record(seed, 0, candidates=1) for seed in (3, 4)]
    failure = {"success": False, "failure": "grasp: unreachable", "feasible": False}
    records[0].candidates[0] |= {"start_in_base": np.full(7, np.nan), **failure}
    write_candidates(tmp_path / "c.h5", records, ENV_INFO, SETTINGS)
    (found,) = validate_candidates(tmp_path / "c.h5").violations
    assert found.key == "candidates/start_in_base, row 0"


def test_seeds_are_consecutive(tmp_path):
    records = [make_record(seed, 0) for seed in (3, 4, 3)]
    write_candidates(tmp_path / "c.h5", records, ENV_INFO, SETTINGS)
    (found,) = validate_candidates(tmp_path / "c.h5").violations
    assert found.key == "decisions/seed, row 2"


def test_wrong_shape_is_one_violation(tmp_path):
    path = write_episodes(tmp_path / "c.h5")
    with h5py.File(path, "r+") as file:
        del file["candidates/slot"]
    (found,) = validate_candidates(path).violations
    assert found.key == "candidates/slot"


def test_truncated_file_is_known_by_its_name(tmp_path):
    path = write_episodes(tmp_path / "candidates.h5")
    path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])
    found = detect_format(path)
    assert found is not None
    assert found.name == CANDIDATES
    assert len(validate_candidates(path).violations) == 1
