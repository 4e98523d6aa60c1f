"""Answer the requests of clients by calls of a policy."""

from __future__ import annotations

import itertools
import logging
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import Any

from numpy.typing import NDArray

from robocas_ms3.core.errors import EvaluationError, PolicyFailed, RobocasError, WireError
from robocas_ms3.core.paths import builtin_packs_dir, data_dir, protocols_dir
from robocas_ms3.core.words import error_line, one_line
from robocas_ms3.evaluation.policy import EpisodeSpec, Observations, Policy, as_chunks, policy_code
from robocas_ms3.evaluation.remote.messages import (
    ACTIONS,
    BATCH,
    ENV,
    ERROR,
    FILE_NAME_PARTS,
    MAX_TEXT,
    PROMPT,
    RESET,
    START,
    batch_of,
    read_observations,
)
from robocas_ms3.evaluation.remote.wire import unpack

_log = logging.getLogger(__name__)
_MAX_ENVS = 1024  # of all clients
_LARGEST_NUMBER = 2**32 - 1  # of episodes and seeds


@dataclass(frozen=True)
class ServedFiles:
    """Files and packs that clients may choose by name. No text of a message becomes a path.

    Attributes:
        files: paths of configurations and layouts, by the names that messages have for them, such as
            ``smoke/configs/pick.yaml``, and by themselves, for clients on the same machine.
        packs: names, or folders as protocols of the server have them.
    """

    files: dict[str, str]
    packs: frozenset[str]

    @classmethod
    def of(cls, protocols: Iterable[Path] = (), packs: Iterable[str] = ()) -> ServedFiles:
        """Collect the files of shipped protocols and installed packs, and of other protocols and their packs.

        Raises:
            EvaluationError: two protocols have the same name.
        """
        folders = {folder.name: folder for folder in protocols_dir().iterdir()}
        for folder in protocols:
            if folder.resolve() != folders.setdefault(folder.name, folder).resolve():
                what, fix = "two protocols have one name", "Rename the folder."
                raise EvaluationError(what, where=folder, found=folders[folder.name], fix=fix)
        files = {}
        for pattern in ("configs/*.yaml", "layouts/*.npy"):
            for path in itertools.chain.from_iterable(folder.glob(pattern) for folder in folders.values()):
                files["/".join(path.parts[-FILE_NAME_PARTS:])] = files[str(path)] = str(path)
        installed = (builtin_packs_dir(), data_dir() / "packs")
        names = {folder.name for parent in installed if parent.is_dir() for folder in parent.iterdir()}
        return cls(files, frozenset({*names, *packs}))

    def resolved(self, start: EpisodeSpec) -> EpisodeSpec:
        """Return a client's episode with paths of this machine; empty: files and packs that are not served."""
        config, layouts = (self.files.get(name, "") for name in (start.config_file, start.layouts_file))
        pack = start.pack if start.pack in self.packs else ""
        return replace(start, config_file=config, layouts_file=layouts, pack=pack)


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
        """Return the answer to a packed message.

        ``envs`` has the policy's env by the client's, of this connection; new ones are added.

        Raises:
            WireError: the request is invalid.
            Exception: whatever the policy raises, without a batch.
        """
        message = unpack(data, self._max_bytes) if isinstance(data, bytes) else None
        if not isinstance(message, dict):
            raise WireError("no observation", expected="a map")
        if BATCH not in message:
            return {ACTIONS: self._act(*self._read([message], envs))[0]}
        observations, starts = self._read(batch_of(message, 1, self._max_batch), envs)
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
                starts.append(self._files.resolved(read_episode_spec(message, number)))
        if len(set(numbers)) < len(numbers):
            raise WireError("invalid batch", where=ENV, expected="each env once", found=sorted(numbers))
        return read_observations(messages, numbers, self._spec), starts

    def _env(self, message: dict[str, Any], envs: dict[int, int]) -> tuple[int, bool]:
        """Return the policy's number of a message's env, and whether an episode starts."""
        env, reset = message.get(ENV, 0), message.get(RESET)
        if type(env) is not int or not (reset is None or isinstance(reset, bool)):
            raise WireError("no observation", expected=f"an integer {ENV}, and a bool {RESET}")
        if env in envs:
            return envs[env], bool(reset)
        if reset is False:
            raise WireError("no episode is running", where=f"{ENV} {env}", expected=f"{RESET}: true first")
        if len(self._used) >= _MAX_ENVS:
            raise WireError("too many envs", expected=f"{_MAX_ENVS} at most")
        wanted = [env] if 0 <= env < _MAX_ENVS else []  # the client's number, if it is free
        envs[env] = next(number for number in itertools.chain(wanted, itertools.count()) if number not in self._used)
        self._used.add(envs[env])
        return envs[env], True

    def _act(self, observations: Observations, starts: list[EpisodeSpec]) -> NDArray[Any]:
        """Return the policy's (E, H, A) actions."""
        with policy_code(self._policy):
            if starts:
                self._policy.reset(starts)
            return as_chunks(self._policy.act(observations), len(observations.envs), None)

    def _act_or_explain(self, observations: Observations, starts: list[EpisodeSpec]) -> tuple[Any, dict[int, str]]:
        """Return the policy's (E, H, A) actions, and by env why it has none; an error without an env is that of all."""
        reasons: dict[int, str] = {}
        try:
            return self._act(observations, starts), {}
        except PolicyFailed as failed:
            _log.warning("%s", failed)
            reasons, text = (
                {env: one_line(reason, 300) for env, reason in failed.reasons.items()},
                error_line(failed, 300),
            )
            if failed.actions is not None:
                return as_chunks(failed.actions, len(observations.envs), None), reasons
        except RobocasError as error:
            _log.warning("the policy failed: %s", error)
            text = error_line(error, 300)
        except Exception as error:  # a policy may raise anything; other clients are still served
            _log.exception("the policy failed")
            text = error_line(error, 300)
        return None, {env: reasons.get(env, text) for env in observations.envs.tolist()}


def read_episode_spec(message: Mapping[str, Any], env: int) -> EpisodeSpec:
    """Return the episode that starts in an env of the policy; some clients tell only its instruction.

    Raises:
        WireError: a value is unknown, or of another type or size.
    """
    blank = EpisodeSpec(env, 0, "", "", "", "", 0, message.get(PROMPT, ""))
    said = message.get(START, {})
    if not isinstance(said, dict) or not said.keys() <= {field.name for field in fields(blank)} - {"env"}:
        raise WireError("invalid start of an episode", where=START, found=one_line(said, 300))
    for name, value in said.items():
        fits = (
            len(value) <= MAX_TEXT if isinstance(value, str) else type(value) is int and 0 <= value <= _LARGEST_NUMBER
        )
        if not fits or type(value) is not type(getattr(blank, name)):
            expected = f"at most {MAX_TEXT} characters, or 0 to {_LARGEST_NUMBER}"
            found = one_line(repr(value), 80)
            raise WireError("invalid start of an episode", where=f"{START}.{name}", expected=expected, found=found)
    return replace(blank, **said)
