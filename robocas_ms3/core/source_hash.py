"""Hash of the source code of this package."""

from __future__ import annotations

import hashlib
from pathlib import Path

import robocas_ms3


def hash_source() -> str:
    """Return the hex SHA-256 of all Python files of robocas_ms3, with their paths.

    It tells apart states of a checkout that have the same version.
    """
    root, digest = Path(robocas_ms3.__file__).parent, hashlib.sha256()
    for path in sorted(root.rglob("*.py")):
        content = path.read_bytes()
        digest.update(f"{path.relative_to(root).as_posix()} {len(content)}\n".encode() + content)
    return digest.hexdigest()
