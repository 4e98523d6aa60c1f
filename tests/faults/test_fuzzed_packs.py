"""Whatever files of a pack or lines of a ledger hold: they are read whole, or refused by one of our errors."""

import io
import json
import warnings
import zipfile
from dataclasses import dataclass, field

import numpy as np
import pytest
from fuzzing import SCALARS, flipped
from hypothesis import given, settings
from hypothesis import strategies as st

from robocas_ms3.assets.annotations import Annotations
from robocas_ms3.assets.hulls import read_hulls
from robocas_ms3.assets.pack import load_pack
from robocas_ms3.core import documents
from robocas_ms3.core.documents import DocumentError, open_arrays
from robocas_ms3.core.errors import AssetError, DatasetError
from robocas_ms3.core.ledger import Ledger
from robocas_ms3.core.paths import builtin_packs_dir

QUICK = settings(max_examples=40, deadline=None, derandomize=True)
PACK = builtin_packs_dir() / "builtin"
OBJECT = min(PACK.glob("*/annotations.npz")).parent
MANIFEST = json.loads((PACK / "manifest.json").read_text())
HUGE = np.array(2**63, np.uint64)
ARRAYS = st.sampled_from(
    [np.zeros(0), np.array("x"), np.array([1, 2]), np.full((2, 4, 4), np.nan), HUGE, np.array(True), np.array(-7)]
)
KEYS = st.sampled_from(["a", "kind", "min", "mass"])
JSON = st.recursive(
    st.sampled_from(SCALARS), lambda inner: st.lists(inner, max_size=3) | st.dictionaries(KEYS, inner), max_leaves=4
)
LINE = st.fixed_dictionaries({"seed": JSON}, optional={"more": JSON, "seconds": JSON})


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    return tmp_path_factory.mktemp("fuzzed")


def one_line(error):
    assert "\n" not in str(error)


@QUICK
@given(seed=st.integers(0, 10**6), name=st.sampled_from(["v", "f", "o"]), word=st.text() | st.floats().map(str))
def test_hulls(folder, seed, name, word):
    whole = (OBJECT / "hulls.obj").read_bytes()[:4000]
    for content in (flipped(whole, seed), whole + f"\n{name} {word} 1 {seed}".encode()):
        (folder / "hulls.obj").write_bytes(content)
        try:
            for hull in read_hulls(folder / "hulls.obj"):
                assert np.isfinite(hull.vertices).all()
                assert 0 <= hull.faces.min() <= hull.faces.max() < len(hull.vertices)
        except AssetError as error:
            one_line(error)


@QUICK
@given(seed=st.integers(0, 10**6), data=st.data())
def test_annotations(folder, seed, data):
    path, whole = folder / "annotations.npz", (OBJECT / "annotations.npz").read_bytes()
    arrays = dict(np.load(OBJECT / "annotations.npz"))
    made = io.BytesIO()
    np.savez(made, **{**arrays, data.draw(st.sampled_from(sorted(arrays))): data.draw(ARRAYS)})
    for content in (flipped(whole, seed), made.getvalue()):
        path.write_bytes(content)
        try:
            with warnings.catch_warnings():
                warnings.simplefilter("error", RuntimeWarning)
                notes = Annotations.load(path)
            assert np.isfinite(notes.grasps_tcp_in_object).all()
            assert -1 <= notes.display_pose < len(notes.resting_poses)
        except AssetError as error:
            one_line(error)


@QUICK
@given(value=JSON, data=st.data())
def test_manifests(folder, value, data):
    asset = next(entry for entry in MANIFEST["assets"] if entry["id"] == OBJECT.name)
    key = data.draw(st.sampled_from(sorted(asset)))
    (folder / "manifest.json").write_text(json.dumps({**MANIFEST, "assets": [{**asset, key: value}]}))
    with pytest.raises(AssetError) as caught:  # of a sound manifest, the files are missing
        load_pack(folder)
    one_line(caught.value)


@dataclass(frozen=True)
class Try:
    seed: int
    seconds: float = 0.0
    words: dict[str, int | None] = field(default_factory=dict)
    more: object = None


@QUICK
@given(lines=st.lists(st.binary(max_size=20) | JSON | LINE, max_size=5))
def test_ledgers(folder, lines):
    ledger: Ledger[Try] = Ledger(folder / "tries.jsonl", Try)
    texts = [line if isinstance(line, bytes) else json.dumps(line).encode() for line in lines]
    ledger.path.write_bytes(b"\n".join(texts))
    for line in ledger.lines():
        if line.record is None:
            one_line(ledger.refusal(line, DatasetError, "no try"))
        else:
            json.dumps([line.record.seconds, line.record.more], allow_nan=False)
    ledger.append([Try(1)])
    assert ledger.read()[-1] == Try(1)


def test_arrays_that_unpack_to_more_than_there_may_be(tmp_path, monkeypatch):
    monkeypatch.setattr(documents, "ARRAYS_LIMIT", 2**20)
    path = tmp_path / "annotations.npz"
    np.savez_compressed(path, zeros=np.zeros(2**20))
    assert path.stat().st_size < 2**14
    with pytest.raises(DocumentError):
        open_arrays(path)
    with pytest.raises(AssetError):
        Annotations.load(path)
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr("resting_poses.npy", b"\x93NUMPY\x01\x00")
    with pytest.raises(AssetError, match="can't read the annotations"):
        Annotations.load(path)
