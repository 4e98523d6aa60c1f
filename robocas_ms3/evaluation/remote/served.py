"""Files that clients of a policy server may choose: those of shipped protocols, and of protocols it was started with.

A message names a file by its protocol's folder, ``smoke/configs/pick.yaml``. No text of a message becomes a path.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, replace
from pathlib import Path

from robocas_ms3.core.errors import EvaluationError
from robocas_ms3.core.paths import builtin_packs_dir, data_dir, protocols_dir
from robocas_ms3.evaluation.policy import EpisodeSpec

_PARTS = 3  # of a file's name in messages: folder of the protocol, folder in it, file


@dataclass(frozen=True)
class ServedFiles:
    """Files and packs by the names that messages have for them.

    Attributes:
        configs: paths of configurations by name.
        layouts: paths of layouts by name.
        packs: names, or folders as protocols of the server have them.
    """

    configs: dict[str, str]
    layouts: dict[str, str]
    packs: frozenset[str]

    @classmethod
    def of(cls, protocols: Iterable[Path] = (), packs: Iterable[str] = ()) -> ServedFiles:
        """Collect the files of shipped protocols, and of others.

        Args:
            protocols: folders of others.
            packs: that these name.

        Raises:
            EvaluationError: two of them have one name.
        """
        folders = {folder.name: folder for folder in protocols_dir().iterdir()}
        for folder in protocols:
            if folder.resolve() != folders.setdefault(folder.name, folder).resolve():
                what, fix = "two protocols have one name", "Rename the folder."
                raise EvaluationError(what, where=folder, found=folders[folder.name], fix=fix)
        installed = (builtin_packs_dir(), data_dir() / "packs")
        names = {folder.name for parent in installed if parent.is_dir() for folder in parent.iterdir()}
        configs, layouts = ("configs/*.yaml", "layouts/*.npy")
        return cls(_named(folders.values(), configs), _named(folders.values(), layouts), frozenset({*names, *packs}))

    def resolved(self, start: EpisodeSpec) -> EpisodeSpec:
        """Return a client's start with paths of this machine; empty: files and packs that are not served."""
        return replace(
            start,
            config_file=self.configs.get(start.config_file, ""),
            layouts_file=self.layouts.get(start.layouts_file, ""),
            pack=start.pack if start.pack in self.packs else "",
        )


def name_of(path: str) -> str:
    """Return the name of a protocol's file in messages; its path if a shipped protocol has that name."""
    parts = Path(path).parts
    shipped = protocols_dir()
    if len(parts) < _PARTS or ((shipped / parts[-_PARTS]).exists() and not Path(path).is_relative_to(shipped)):
        return path
    return "/".join(parts[-_PARTS:])


def _named(folders: Iterable[Path], pattern: str) -> dict[str, str]:
    return {name: str(path) for folder in folders for path in folder.glob(pattern) for name in _names(path)}


def _names(path: Path) -> tuple[str, str]:
    """The name of a file in messages, and its path, which a client on the same machine may know."""
    return "/".join(path.parts[-_PARTS:]), str(path)
