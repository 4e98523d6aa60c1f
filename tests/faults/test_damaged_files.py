"""Damaged files of layout caches, JSON lines, arrays and training runs are repaired, skipped or an error."""

import json
import shutil
import zipfile
from dataclasses import dataclass, field

import numpy as np
import pytest
from fuzzing import SCALARS, VALUES, change_value, damage
from hypothesis import given, settings
from hypothesis import strategies as st

from robocas_ms3.assets.annotations import Annotations
from robocas_ms3.assets.pack import load_pack
from robocas_ms3.baselines.training.record import BUNDLED
from robocas_ms3.cli.layouts import Info, info
from robocas_ms3.core import documents
from robocas_ms3.core.documents import DocumentError, open_npz
from robocas_ms3.core.errors import AssetError, DatasetError, TrainingError
from robocas_ms3.core.json_lines import JsonLinesFile
from robocas_ms3.core.poses import from_xyz_yaw
from robocas_ms3.demos.failures import FailedAttempt
from robocas_ms3.scenes.cache import ABOUT, LayoutCache
from robocas_ms3.scenes.config import load_task_config
from robocas_ms3.scenes.layout import Layout
from robocas_ms3.scenes.model import SceneModel


@pytest.fixture
def cache(tmp_path, monkeypatch):
    """A layout cache with a constant layout, which takes no time to sample."""
    pack = load_pack("builtin")
    cache = LayoutCache(SceneModel.load(load_task_config("pick_table_scattered"), pack, pack), tmp_path)
    poses = np.stack([from_xyz_yaw(0.1 * i, 0.2, 0.6, i) for i in range(3)])
    layout = Layout(
        tuple(cache._names[:3]), poses, from_xyz_yaw(0.7, 0.15, 0, 1.5), from_xyz_yaw(1.3, 0.9, 0.6, 0), target=1
    )
    monkeypatch.setattr(cache._sample, "sample", lambda *_: layout)
    return cache


def test_damaged_layout_of_a_cache_is_sampled_again(cache):
    made = cache.get(0, 0)
    path = cache.layout_path(0, 0)
    whole = path.read_bytes()
    for seed in range(80):
        path.write_bytes(damage(path.name, whole, seed))
        again = cache.get(0, 0)
        assert again.object_ids == made.object_ids, seed
        assert np.array_equal(again.object_poses, made.object_poses), seed


def test_caches_with_damaged_description_are_listed(cache, capsys):
    cache.get(0, 0)
    path = cache.folder / ABOUT
    whole = json.loads(path.read_text())
    for content in [*(change_value(whole, seed) for seed in range(60)), *VALUES]:
        path.write_text(json.dumps(content))
        assert info(Info(folder=cache.folder.parent)) == 0, content
    assert "damaged" in capsys.readouterr().out


@dataclass(frozen=True)
class Try:
    seed: int
    seconds: float = 0.0
    words: dict[str, int | None] = field(default_factory=dict)
    more: object = None


JSON = st.recursive(
    st.sampled_from(SCALARS),
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(st.text(), inner),
    max_leaves=4,
)
LINE = st.fixed_dictionaries({"seed": JSON}, optional={"more": JSON, "seconds": JSON})


@settings(max_examples=40, deadline=None, derandomize=True)
@given(lines=st.lists(st.binary(max_size=20) | JSON | LINE, max_size=5))
def test_json_lines(tmp_path_factory, lines):
    ledger: JsonLinesFile[Try] = JsonLinesFile(tmp_path_factory.mktemp("ledger") / "tries.jsonl", Try)
    texts = [line if isinstance(line, bytes) else json.dumps(line).encode() for line in lines]
    ledger.path.write_bytes(b"\n".join(texts))
    for line in ledger.read_lines():
        if line.record is None:
            assert "\n" not in str(ledger.make_line_error(line, DatasetError, "no try"))
        else:
            json.dumps([line.record.seconds, line.record.more], allow_nan=False)
    ledger.append([Try(1)])
    assert ledger.read()[-1] == Try(1)


FAILURE = {"seed": 1, "attempt": 0, "stage": "a", "reason": "b", "seconds": 1.0}


@pytest.mark.parametrize("changes", [{"attempt": -2}, {"seed": 2**62}, {"seconds": 1e308}, {"seconds": True}])
def test_failed_attempt_out_of_range_is_skipped(tmp_path, changes):
    (tmp_path / "failures.jsonl").write_text(json.dumps({**FAILURE, **changes}) + "\n")
    assert JsonLinesFile(tmp_path / "failures.jsonl", FailedAttempt).read() == []


def test_arrays_over_the_size_limit(tmp_path, monkeypatch):
    monkeypatch.setattr(documents, "ARRAYS_LIMIT", 2**20)
    path = tmp_path / "annotations.npz"
    np.savez_compressed(path, zeros=np.zeros(2**20))
    assert path.stat().st_size < 2**14
    for read, error in ((open_npz, DocumentError), (Annotations.load, AssetError)):
        with pytest.raises(error):
            read(path)
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr("resting_poses.npy", b"\x93NUMPY\x01\x00")  # a header that is cut off
    with pytest.raises(AssetError):
        Annotations.load(path)


def test_facts_and_checkpoints_of_a_run(tmp_path):
    torch = pytest.importorskip("torch", reason="needs torch")
    from safetensors.torch import save_file

    from robocas_ms3.baselines.policy import RunPolicy
    from robocas_ms3.baselines.training import checkpoints

    root = shutil.copytree(BUNDLED / "small", tmp_path / "run")
    whole = json.loads((root / "run.json").read_text())
    facts = whole["facts"]
    for changes in ({"chunk": {**facts["chunk"], "mean": "x"}}, {"heights": []}, {"image_sizes": {"base_camera": [1]}}):
        (root / "run.json").write_text(json.dumps({**whole, "facts": {**facts, **changes}}))
        with pytest.raises(TrainingError):
            RunPolicy(root, "cpu")
    small = root / "small.safetensors"
    for metadata in ({"step": ""}, {"step": "-1"}, {"step": "nan"}, {"step": "1e308"}, {"step": "9" * 5000}, {}):
        save_file({"a": torch.zeros(1)}, small, metadata)
        with pytest.raises(TrainingError) as error:
            checkpoints.load_checkpoint(small, {})
        assert len(str(error.value)) < 500
