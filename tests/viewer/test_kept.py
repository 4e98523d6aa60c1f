"""Decoded pictures in memory: how many bytes, and which ones stay."""

import numpy as np

from robocas_ms3.viewer.kept import KeptPictures


def test_those_used_last_stay_within_their_bytes():
    kept, made = KeptPictures(25), []

    def get(key, size=10):
        group = kept.get(key, lambda: made.append(key) or [np.zeros(size // 2, np.uint8)] * 2)
        assert sum(picture.nbytes for picture in group) == size

    for key in "ababcab":  # c puts a out, which was used before b; a then puts b out, and b puts c out
        get(key)
    assert made == list("abcab")
    get("large", 100)  # by itself
    get("large", 100)
    get("b")
    get("a")
    get("b")
    assert made == ["a", "b", "c", "a", "b", "large", "b", "a"]
