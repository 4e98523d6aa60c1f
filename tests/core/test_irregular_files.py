"""Pipes, devices and files of absurd sizes in packs, protocols, results and plans are one typed error each, at once."""

import shutil
from pathlib import Path

import made_up_results
import pytest
from irregular import KINDS, replace_file

from robocas_ms3.assets.hulls import read_hulls
from robocas_ms3.assets.pack import load_pack
from robocas_ms3.core.documents import DocumentError
from robocas_ms3.core.errors import AssetError, ConfigError, EvaluationError, PlanError
from robocas_ms3.core.ledger import Ledger
from robocas_ms3.core.paths import builtin_packs_dir
from robocas_ms3.evaluation import results
from robocas_ms3.evaluation.protocol import load_protocol, shipped_protocols
from robocas_ms3.plans.folder import PLAN, read_plan
from robocas_ms3.plans.units import OUTCOME, Outcome, SeedFiles


@pytest.mark.parametrize("kind", KINDS)
def test_packs(tmp_path, kind):
    root = shutil.copytree(next(path.parent for path in builtin_packs_dir().glob("*/manifest.json")), tmp_path / "pack")
    path = replace_file(next(root.glob("*/visual_fast.glb")), kind)
    with pytest.raises(AssetError) as error:
        load_pack(root)
    assert error.value.where == path
    replace_file(root / "manifest.json", kind)
    with pytest.raises(AssetError):
        load_pack(root)
    with pytest.raises(AssetError) as error:
        read_hulls(replace_file(tmp_path / "hulls.obj", kind))
    assert error.value.where == tmp_path / "hulls.obj"


@pytest.mark.parametrize("kind", KINDS)
def test_protocols(tmp_path, kind):
    source = Path(shipped_protocols()["ms3-v1"])
    root = shutil.copytree(source, tmp_path / "protocol")
    assert load_protocol(root).hash == load_protocol(source).hash
    path = replace_file(root / "configs" / "other.yaml", kind)
    with pytest.raises(ConfigError) as error:
        load_protocol(root)
    assert error.value.where == path
    path = replace_file(root / "episodes.jsonl", kind)
    with pytest.raises(EvaluationError) as error:
        load_protocol(root)
    assert error.value.where == path


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("name", [results.RUN, results.OUTCOMES])
def test_results(tmp_path, name, kind):
    folder = tmp_path / "result"
    made_up_results.write(folder, [made_up_results.outcome(0)])
    replace_file(folder / name, kind)
    with pytest.raises(EvaluationError):
        results.read(folder)


@pytest.mark.parametrize("kind", KINDS)
def test_files_of_plans(tmp_path, kind):
    replace_file(tmp_path / OUTCOME, kind)
    assert SeedFiles(0, 1, tmp_path).outcome() is None
    with pytest.raises(DocumentError):
        Ledger(replace_file(tmp_path / "ledger.jsonl", kind), Outcome).lines()
    replace_file(tmp_path / PLAN, kind)
    with pytest.raises(PlanError):
        read_plan(tmp_path)
