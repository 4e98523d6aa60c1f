"""Folders of files that are generated when they are first asked for, and kept."""

from __future__ import annotations

import json
import os
import shutil
import tempfile
from collections.abc import Callable
from pathlib import Path

from robocas_ms3.core.documents import load_json
from robocas_ms3.core.files import make_folder, naming


def made_once(folder: Path, make: Callable[[Path], None]) -> None:
    """Have a folder made, unless it is there and complete.

    Two processes may do this at once: a folder appears whole, and the first one wins.

    Args:
        folder: its name says all that the files are made from.
        make: writes them into an empty folder.

    Raises:
        RobocasError: it can't be made there.
        OSError: it can't be written, naming it; nothing is left of it.
    """
    if _is_complete(folder):
        return
    make_folder(folder.parent)
    with naming(folder):
        tmp = Path(tempfile.mkdtemp(prefix=f".{folder.name}.", suffix=".tmp", dir=folder.parent))
        try:
            tmp.chmod(0o755)
            make(tmp)
            names = sorted(str(path.relative_to(tmp)) for path in tmp.rglob("*") if path.is_file())
            (tmp / "files.json").write_text(json.dumps(names, indent=1), encoding="utf-8")
            _publish(tmp, folder)
        finally:
            shutil.rmtree(tmp, ignore_errors=True)


def _publish(tmp: Path, folder: Path) -> None:
    """Rename ``tmp`` to ``folder``; keep a complete folder another process has put there meanwhile."""
    try:
        os.rename(tmp, folder)
    except OSError:
        if _is_complete(folder):
            return
        damaged = Path(tempfile.mkdtemp(prefix=f".{folder.name}.", suffix=".old", dir=folder.parent))
        os.rename(folder, damaged / "old")
        os.rename(tmp, folder)
        shutil.rmtree(damaged, ignore_errors=True)


def _is_complete(folder: Path) -> bool:
    try:
        names = load_json(folder / "files.json")
    except (OSError, ValueError):
        return False
    return isinstance(names, list) and all((folder / name).is_file() for name in names)
