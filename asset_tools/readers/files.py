"""Read files of a model safely: only regular files of limited size in the imported folder."""

from __future__ import annotations

import os
import stat
import unicodedata
from collections.abc import Iterator
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from urllib.parse import unquote

from robocas_ms3.core.errors import AssetError

LARGEST_FILE = 200 * 2**20  # bytes
TEXTURE_FOLDERS = {"textures", "texture", "tex", "materials", "images", "maps", "thumbnails"}
MOST_ENTRIES = 20_000  # maximum number of entries of a searched folder


def read_file(path: Path, *roots: Path) -> bytes:
    """Read a regular file in the imported folder.

    Args:
        path: path of the file.
        roots: folders from which files may be read, including their subfolders.

    Raises:
        AssetError: the file is missing, outside of ``roots``, not regular (pipe, device), or larger than 200 MB.
    """
    check_inside(path, *roots)
    try:
        # without O_NONBLOCK, opening a named pipe waits for a writer
        descriptor = os.open(path, os.O_RDONLY | os.O_NONBLOCK | os.O_CLOEXEC)
        with open(descriptor, "rb") as file:
            status = os.fstat(descriptor)
            if not stat.S_ISREG(status.st_mode):
                raise AssetError(
                    "not a regular file",
                    where=path,
                    expected="a file with content",
                    found="a folder" if stat.S_ISDIR(status.st_mode) else "a pipe, socket or device",
                    fix="Replace it by the file itself.",
                )
            if status.st_size > LARGEST_FILE:
                raise AssetError(
                    "the file is too large",
                    where=path,
                    expected=f"at most {LARGEST_FILE >> 20} MB",
                    found=f"{status.st_size >> 20} MB",
                    fix="Reduce the mesh, or shrink its textures.",
                )
            return file.read(LARGEST_FILE + 1)
    except OSError as error:
        raise AssetError("cannot read this file", where=path, found=error.strerror) from error


def check_inside(path: Path, *roots: Path) -> None:
    """Check that a path is below one of several folders, after links in both paths are resolved.

    Raises:
        AssetError: the path is outside all folders, or cannot be resolved.
    """
    try:
        inside = any(path.resolve().is_relative_to(root.resolve()) for root in roots)
    except (OSError, RuntimeError, ValueError) as error:  # a loop of links, a null byte
        raise AssetError("cannot read this file", where=path, found=error) from error
    if not inside:
        raise AssetError(
            "the path leads out of the imported folder",
            where=path,
            expected=f"a file below {roots[0]}",
            fix="Copy the file into the folder, or import the folder that contains both.",
        )


@dataclass
class ModelFiles:
    """The files of one model.

    Attributes:
        root: the imported folder. Only files below ``root`` or ``home`` are read.
        home: the folder of the model, in which files are searched by name; may be a link.
        stem: stem of the mesh file, if ``home`` also contains other models; None: ``home`` belongs to this model.
        notes: notes on replaced and ignored files, one line each.
        used: files that were read, for the hash of the inputs.
    """

    root: Path
    home: Path
    stem: str | None = None
    notes: list[str] = field(default_factory=list)
    used: list[Path] = field(default_factory=list)

    @cached_property
    def searchable_files(self) -> list[Path]:
        """Files among which missing files are searched by name.

        If ``stem`` is None, these are all files below ``home``. Otherwise they are the files in ``home``, and those in
        subfolders for textures or with the name of the model.
        """
        if self.stem is None:
            return list(find_files(self.home))
        entries = sorted(path for path in self.home.iterdir() if not path.name.startswith("."))
        own = [path for path in entries if path.is_dir() and _is_for(path.name, self.stem)]
        return [path for path in entries if not path.is_dir()] + [file for path in own for file in find_files(path)]

    def read(self, path: Path) -> bytes:
        """Return the content of a file below ``root`` or ``home``, and add the file to ``used``."""
        data = read_file(path, self.root, self.home)
        if path not in self.used:
            self.used.append(path)
        return data

    def find(self, name: str, folder: Path) -> Path | None:
        """Find a file by the path that is written in a model.

        This path may come from another machine, or differ in letter case. If no file has this path, the function
        searches ``searchable_files`` for the file name alone.

        Args:
            name: path in the model: relative to ``folder``, or absolute; with slashes or backslashes.
            folder: folder of the file in which the path is written.

        Returns:
            The path of the file; None if there is no such file.

        Raises:
            AssetError: the path leads out of ``root``, and no file of ``searchable_files`` has this file name.
        """
        name = name.strip().strip('"')
        plain = name.replace("\\", "/").removeprefix("file://")
        if not plain or "\0" in plain:
            return None
        relative = not plain.startswith("/") and not (len(plain) > 1 and plain[1] == ":")
        path = Path(os.path.normpath(folder / plain))
        outside = relative and not path.is_relative_to(self.root)
        if relative and not outside and os.path.lexists(path) and not path.is_dir():
            if plain != name:
                self._note(f"read {name} as {plain}")
            return path
        wanted = _letters(plain.rsplit("/", 1)[-1])
        alike = [found for found in self.searchable_files if _letters(found.name) == wanted]
        if alike:
            found = min(alike, key=lambda path: (len(path.parts), path.as_posix()))
            taken = found.relative_to(self.home).as_posix()
            text = f"used {taken} instead of {name if name != taken else folder.name + '/' + name}"
            self._note(f"warning: {text}, one of {len(alike)} files of this name" if len(alike) > 1 else text)
            return found
        if "%" in name and unquote(name) != name:
            return self.find(unquote(name), folder)
        if outside:
            check_inside(folder / plain, self.root)
        return None

    def _note(self, text: str) -> None:
        if text not in self.notes:
            self.notes.append(text)


def format_missing_path(name: str, folder: Path) -> Path:
    """Return the path for the message of an error about a file that `ModelFiles.find` did not find.

    Args:
        name: path in the model.
        folder: folder of the file in which the path is written.
    """
    plain = name.replace("\\", "/")
    return Path(plain) if ":" in plain else folder / plain


def find_files(folder: Path) -> Iterator[Path]:
    """Yield the files below a folder, sorted by name, without hidden files and linked folders."""
    count = 0
    for place, folders, names in os.walk(folder):
        folders[:] = sorted(name for name in folders if not name.startswith("."))
        for name in sorted(names):
            count += 1
            if count > MOST_ENTRIES:
                return
            if not name.startswith("."):
                yield Path(place, name)


def _is_for(folder: str, stem: str) -> bool:
    """Return whether a folder may contain the textures of the mesh file ``stem`` next to the folder."""
    return folder.lower() in TEXTURE_FOLDERS or _letters(folder).startswith(_letters(stem))


def _letters(name: str) -> str:
    """Return a name in lower case and with normalised accents, for comparisons."""
    return unicodedata.normalize("NFC", name).casefold()
