"""Answer the requests of clients by calls of a policy."""

from __future__ import annotations

import itertools
import logging
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from robocas_ms3.core.errors import EvaluationError, PolicyFailed, RobocasError, WireError
from robocas_ms3.core.paths import builtin_packs_dir, data_dir, protocols_dir
from robocas_ms3.evaluation.policy import EpisodeSpec, Observations, Policy, policy_code
from robocas_ms3.evaluation.remote.messages import (
    ACTIONS,
    BATCH,
    ENV,
    ERROR,
    FILE_NAME_PARTS,
    PROMPT,
    RESET,
    START,
    batch_of,
    check_length,
    observations_of,
    one_line,
    short_line,
    stack_observations,
)
from robocas_ms3.evaluation.remote.wire import unpack

_LOG = logging.getLogger(__name__)
_MAX_ENVS = 1024  # of all clients
_LARGEST_NUMBER = 2**32 - 1  # of episodes and seeds


@dataclass(frozen=True)
class ServedFiles:
    """Files and packs that clients may choose, by the names that messages have for them.

    A message names a file by its protocol's folder, ``smoke/configs/pick.yaml``. No text of a message becomes a path.

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


class Answers:
    """Convert requests to calls of a policy, and actions to answers.

    A batched request is one call of ``reset`` with all episodes that start and one call of ``act`` with all
    observations, both in the request's order, as in an evaluation without a server. A request without a batch is a
    call with one env. An env keeps the client's number unless another client uses it. Clients that send neither
    ``env_id`` nor ``reset``, such as openpi's, have one episode per connection.

    Args:
        policy: that acts.
        files: that clients may choose.
        max_bytes: size limit of a request.
        max_batch: number of envs that a batched request may have.
    """

    def __init__(self, policy: Policy, files: ServedFiles, max_bytes: int, max_batch: int) -> None:
        self._policy, self._files, self._max_bytes, self._max_batch = policy, files, max_bytes, max_batch
        with policy_code(policy):
            self._spec = policy.spec
        self._used: set[int] = set()  # envs of the policy

    def answer(self, data: str | bytes, envs: dict[int, int]) -> dict[str, Any]:
        """Return the answer to a request.

        Args:
            data: packed message.
            envs: the policy's env by the client's, of this connection; new ones are added.

        Raises:
            WireError: the request is invalid.
            Exception: whatever the policy raises, without a batch.
        """
        message = unpack(data, self._max_bytes) if isinstance(data, bytes) else None
        if not isinstance(message, dict):
            raise WireError("no observation", expected="a map")
        if BATCH not in message:
            observations, starts = self._read([message], envs)
            return {ACTIONS: self._act(observations, starts)[0]}
        batch = batch_of(message, 1, self._max_batch)
        observations, starts = self._read(batch, envs)
        actions, reasons = self._act_or_explain(observations, starts)
        rows = enumerate(observations.envs.tolist())
        return {BATCH: [{ERROR: reasons[env]} if env in reasons else {ACTIONS: actions[row]} for row, env in rows]}

    def release(self, envs: dict[int, int]) -> None:
        """Make the envs of a closed connection available."""
        self._used -= set(envs.values())

    def _read(self, messages: Sequence[dict[str, Any]], envs: dict[int, int]) -> tuple[Observations, list[EpisodeSpec]]:
        """Return the observations of some messages, and the episodes that start."""
        numbers, starts = [], []
        for message in messages:
            number, reset = self._env(message, envs)
            numbers.append(number)
            if reset:
                starts.append(read_episode_spec(message, number, self._files))
        if len(set(numbers)) < len(numbers):
            raise WireError("invalid batch", where=ENV, expected="each env once", found=sorted(numbers))
        read = [observations_of(message, env, self._spec) for message, env in zip(messages, numbers, strict=True)]
        return stack_observations(read), starts

    def _env(self, message: dict[str, Any], envs: dict[int, int]) -> tuple[int, bool]:
        """Return the policy's number of a message's env, and whether an episode starts."""
        said, reset = message.get(ENV, 0), message.get(RESET)
        if type(said) is not int or not (reset is None or isinstance(reset, bool)):
            raise WireError("no observation", expected=f"a number {ENV}, and whether to {RESET}")
        if said in envs:
            return envs[said], bool(reset)
        if reset is False:
            raise WireError("no episode is running", where=f"{ENV} {said}", expected=f"{RESET}: true first")
        if len(self._used) >= _MAX_ENVS:
            raise WireError("too many envs", expected=f"{_MAX_ENVS} at most")
        wished = [said] if 0 <= said < _MAX_ENVS else []  # the client's number, where it is free
        envs[said] = next(env for env in itertools.chain(wished, itertools.count()) if env not in self._used)
        self._used.add(envs[said])
        return envs[said], True

    def _act(self, observations: Observations, starts: list[EpisodeSpec]) -> NDArray[Any]:
        """Return the policy's (E, H, A) actions."""
        with policy_code(self._policy):
            if starts:
                self._policy.reset(starts)
            return _chunks(self._policy.act(observations), len(observations.envs))

    def _act_or_explain(self, observations: Observations, starts: list[EpisodeSpec]) -> tuple[Any, dict[int, str]]:
        """Return the policy's (E, H, A) actions, and by env why it has none; an error without an env is that of all."""
        try:
            try:
                return self._act(observations, starts), {}
            except PolicyFailed as failed:
                if failed.actions is None:
                    raise
                _LOG.warning("%s", failed)
                return _chunks(failed.actions, len(observations.envs)), _lines(failed)
        except RobocasError as error:
            _LOG.warning("the policy failed: %s", error)
            reasons = _lines(error) if isinstance(error, PolicyFailed) else {}
            text = one_line(error)
        except Exception as error:  # a policy may raise anything; other clients are still served
            _LOG.exception("the policy failed")
            reasons, text = {}, one_line(error)
        return None, {env: reasons.get(env, text) for env in observations.envs.tolist()}


def _chunks(acted: Any, count: int) -> NDArray[Any]:
    """Return (E, H, A) actions of a policy's (E, A) or (E, H, A).

    Raises:
        EvaluationError: they are something else.
    """
    actions = np.asarray(acted)
    if actions.dtype.kind not in "iuf" or actions.ndim not in (2, 3) or len(actions) != count:
        expected = f"({count}, size) or ({count}, chunk, size) numbers"
        raise EvaluationError("actions don't fit", expected=expected, found=f"{actions.shape} {actions.dtype}")
    return actions[:, None] if actions.ndim == 2 else actions


def _lines(failed: PolicyFailed) -> dict[int, str]:
    return {env: one_line(EvaluationError(why)) for env, why in failed.reasons.items()}


def read_episode_spec(message: Mapping[str, Any], env: int, files: ServedFiles) -> EpisodeSpec:
    """Return the episode that starts; of a client that does not say more, the instruction alone.

    Args:
        message: of the client.
        env: of the policy.
        files: that the client may choose.

    Raises:
        WireError: it is no start of an episode.
    """
    blank = EpisodeSpec(env, 0, "", "", "", "", 0, message.get(PROMPT, ""))
    said = message.get(START, {})
    if not isinstance(said, dict) or not said.keys() <= vars(blank).keys() - {"env"}:
        raise WireError("no start of an episode", where=START, found=short_line(said))
    for name, value in said.items():
        if type(value) is not type(getattr(blank, name)):
            raise WireError("no start of an episode", where=f"{START}.{name}", found=short_line(repr(value)))
        if isinstance(value, int) and not 0 <= value <= _LARGEST_NUMBER:
            expected = f"0 to {_LARGEST_NUMBER}"
            raise WireError("number out of range", where=f"{START}.{name}", expected=expected, found=value)
        if isinstance(value, str):
            check_length(f"{START}.{name}", value)
    return files.resolved(EpisodeSpec(**{**vars(blank), **said}))


def _named(folders: Iterable[Path], pattern: str) -> dict[str, str]:
    return {name: str(path) for folder in folders for path in folder.glob(pattern) for name in _names(path)}


def _names(path: Path) -> tuple[str, str]:
    """The name of a file in messages, and its path, which a client on the same machine may know."""
    return "/".join(path.parts[-FILE_NAME_PARTS:]), str(path)
