"""Pipes, devices and files of absurd sizes in packs, protocols, results and plans are one typed error each, at once."""

import shutil
from pathlib import Path

import pytest
import synthetic_results
from irregular import KINDS, replace_file

from robocas_ms3.assets.hulls import read_hulls
from robocas_ms3.assets.pack import load_pack
from robocas_ms3.core.documents import DocumentError
from robocas_ms3.core.errors import AssetError, ConfigError, EvaluationError, PlanError
from robocas_ms3.core.json_lines import JsonLinesFile
from robocas_ms3.core.paths import builtin_packs_dir
from robocas_ms3.evaluation.protocols.bundled_protocols import bundled_protocols
from robocas_ms3.evaluation.protocols.protocol import load_protocol
from robocas_ms3.evaluation.results import result_files
from robocas_ms3.plans.folder import OUTCOME, PLAN, Outcome, SeedFiles, read_plan


def copy_pack(root):
    shutil.copytree(next(path.parent for path in builtin_packs_dir().glob("*/manifest.json")), root)


def copy_protocol(root):
    shutil.copytree(Path(bundled_protocols()["ms3-v1"]), root)


def write_result(root):
    synthetic_results.write(root, [synthetic_results.outcome(0)])


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize(
    ("make", "name", "read", "error"),
    [
        (copy_pack, "plate/visual_fast.glb", load_pack, AssetError),
        (copy_pack, "manifest.json", load_pack, AssetError),
        (Path.mkdir, "hulls.obj", lambda root: read_hulls(root / "hulls.obj"), AssetError),
        (copy_protocol, "configs/other.yaml", load_protocol, ConfigError),
        (copy_protocol, "episodes.jsonl", load_protocol, EvaluationError),
        (write_result, result_files.RUN, result_files.read_result, EvaluationError),
        (write_result, result_files.OUTCOMES, result_files.read_result, EvaluationError),
        (
            write_result,
            "actions/000000.npz",
            lambda root: result_files.read_result(root).read_actions(0),
            EvaluationError,
        ),
        (Path.mkdir, PLAN, read_plan, PlanError),
        (
            Path.mkdir,
            "ledger.jsonl",
            lambda root: JsonLinesFile(root / "ledger.jsonl", Outcome).read_lines(),
            DocumentError,
        ),
    ],
    ids=lambda value: value if isinstance(value, str) else "",
)
def test_irregular_file_is_an_error(tmp_path, kind, make, name, read, error):
    make(tmp_path / "made")
    replace_file(tmp_path / "made" / name, kind)
    with pytest.raises(error) as caught:
        read(tmp_path / "made")
    where = tmp_path / "made" / name, tmp_path / "made"
    assert error is DocumentError or Path(caught.value.where) in where


@pytest.mark.parametrize("kind", KINDS)
def test_irregular_outcome_file_of_a_plan_counts_as_missing(tmp_path, kind):
    replace_file(tmp_path / OUTCOME, kind)
    assert SeedFiles(0, 1, tmp_path).read_outcome() is None
