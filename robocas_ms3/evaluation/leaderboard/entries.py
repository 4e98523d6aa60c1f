"""Entries of the leaderboard: folders with the results of a policy.

::

    keyframe/README.md    model card
    keyframe/paper-v1/    result of `robocas eval` with the stored actions and checkpoints of a sample of its episodes

The hashes of the actions of all episodes are in ``episodes.jsonl``. The model card says what the policy was trained
on, where it works and where it does not, and how to reproduce its results.
"""

from __future__ import annotations

import hashlib
from collections.abc import Collection
from pathlib import Path

from robocas_ms3.core.documents import read_text
from robocas_ms3.core.errors import EvaluationError, OutputExistsError
from robocas_ms3.core.files import atomic_file, atomic_folder, write_json
from robocas_ms3.core.output_folder import check_replaceable
from robocas_ms3.core.text import format_count
from robocas_ms3.evaluation.leaderboard.result_rows import make_rows
from robocas_ms3.evaluation.protocols.protocol import LoadedProtocol
from robocas_ms3.evaluation.results.result_files import RUN, Result, write_outcomes
from robocas_ms3.evaluation.results.stored_episodes import find_checkpoints_file, write_actions, write_checkpoints
from robocas_ms3.evaluation.results.verify import check_consistency, find_violations

CARD = "README.md"
"""Name of the model card in an entry."""
_CARD_BYTES = 2**20
SAMPLE_SIZE = 50
"""Number of episodes of a result whose actions are in an entry."""


def choose_sample(protocol: LoadedProtocol, groups: Collection[tuple[str, str]]) -> list[int]:
    """Return the numbers of the episodes whose actions are in an entry, in ascending order.

    The sample has the episodes with the smallest hashes of protocol and number. The author of a result chooses its
    tasks and splits, but cannot choose episodes of these.

    Args:
        protocol: protocol of the result.
        groups: task and split of the evaluated episodes, as in the protocol.
    """

    def compute_hash(number: int) -> bytes:
        return hashlib.sha256(f"{protocol.hash} {number}".encode()).digest()

    numbers = [episode.episode for episode in protocol.episodes if (episode.task, episode.split) in groups]
    return sorted(sorted(numbers, key=compute_hash)[:SAMPLE_SIZE])


def find_results(entry: Path) -> list[Path]:
    """Return the folders of the results in an entry, sorted.

    Raises:
        EvaluationError: the entry has no result.
    """
    folders = sorted(path.parent for path in entry.rglob(RUN))
    if not folders:
        what, fix = "no result in this entry", "Add one with robocas leaderboard add."
        raise EvaluationError(what, where=entry, expected=f"a folder with {RUN}", fix=fix)
    return folders


def find_groups(result: Result, protocol: LoadedProtocol) -> set[tuple[str, str]]:
    """Return the task and split, as in the protocol, of the episodes of a result; each pair gives a row."""
    return {(one.task, one.split) for one in protocol.episodes if one.episode in result.outcomes}


def count_missing(result: Result, protocol: LoadedProtocol) -> int:
    """Return the number of episodes that a result lacks among those of its tasks and splits."""
    groups = find_groups(result, protocol)
    return sum((one.task, one.split) in groups and one.episode not in result.outcomes for one in protocol.episodes)


def list_stored_episodes(result: Result, protocol: LoadedProtocol) -> list[int]:
    """Return the numbers of the episodes of a result in an entry whose actions must be stored."""
    return choose_sample(protocol, find_groups(result, protocol))


def list_missing_checkpoints(result: Result, protocol: LoadedProtocol) -> list[int]:
    """Return the numbers of the episodes with stored actions that lack checkpoints.

    None if the backend stores no checkpoints. Episodes that ended with an error need none.
    """
    if result.run.backend != "processes":
        return []
    outcomes = [result.outcomes[one] for one in list_stored_episodes(result, protocol) if one in result.outcomes]
    numbers = [outcome.episode for outcome in outcomes if not outcome.error]
    return [one for one in numbers if not find_checkpoints_file(result.folders.get(one, result.folder), one).exists()]


def find_card(folder: Path) -> Path:
    """Return the path of the model card of the entry that contains the folder of a result."""
    return folder.absolute().parent / CARD


def get_entry_name(folder: Path) -> str:
    """Return the name of the entry that contains the folder of a result."""
    return folder.absolute().parent.name


def find_result_violations(result: Result, protocol: LoadedProtocol) -> list[str]:
    """Return one text per violation in a result of an entry (`find_violations`)."""
    found = find_violations(result, protocol, is_complete=False, stored=list_stored_episodes(result, protocol))
    if missing := count_missing(result, protocol):
        found.append(f"{format_count(missing, 'episode')} of its tasks and splits missing")
    found += [f"episode {number}: no checkpoints" for number in list_missing_checkpoints(result, protocol)]
    try:
        make_rows(result, protocol)
    except EvaluationError as error:
        found.append(str(error))
    if result.folder.name != protocol.rules.name:
        found.append(f"the folder {result.folder.name} has another name than the protocol {protocol.rules.name}")
    card = find_card(result.folder)
    if not card.is_file():
        found.append(f"no model card {card}; write it, or pass --card to robocas leaderboard add")
    else:
        try:
            read_card(card)
        except EvaluationError as error:
            found.append(str(error))
    if links := [path for path in (card, result.folder, *sorted(result.folder.rglob("*"))) if path.is_symlink()]:
        found.append(f"{links[0]} is a symbolic link")
    return found


def write_result(
    result: Result, protocol: LoadedProtocol, out: Path, *, card: Path | None = None, overwrite: bool = False
) -> list[int]:
    """Write a result into a folder of an entry, and return the numbers of the episodes of the sample.

    Args:
        result: the result, with all episodes of its tasks and splits.
        protocol: its protocol.
        out: new folder, such as ``leaderboard/keyframe/paper-v1``; written atomically.
        card: model card to copy into the entry; None: the entry keeps its card.
        overwrite: whether to replace an existing result.

    Raises:
        EvaluationError: the result has violations (`find_violations`), lacks episodes of its tasks and splits or
            checkpoints, or ``out`` has another name than the protocol.
        OutputExistsError: ``out`` exists, the entry has another model card, or the folder of the entry has no result,
            but a README.md.
    """
    check_consistency(result, protocol)
    if missing := count_missing(result, protocol):
        what, fix = "the result lacks episodes of its tasks and splits", "Evaluate all episodes."
        found = f"{format_count(missing, 'episode')} missing"
        raise EvaluationError(what, where=result.folder, found=found, fix=fix)
    if without := list_missing_checkpoints(result, protocol):
        what, fix = "the result lacks checkpoints", "Evaluate again with --overwrite."
        found = f"{format_count(len(without), 'episode')} without checkpoints, the first: {without[0]}"
        raise EvaluationError(what, where=result.folder, found=found, fix=fix)
    if out.absolute().name != protocol.rules.name:
        what, fix = "the folder of the result has another name than its protocol", "See robocas leaderboard add --help."
        raise EvaluationError(what, where=out, expected=f"ENTRY/{protocol.rules.name}", fix=fix)
    check_replaceable(out, overwrite=overwrite, markers=(RUN,))
    text = None if card is None else read_card(card)
    if text is not None and find_card(out).exists() and read_card(find_card(out)) != text:
        if not any(find_card(out).parent.glob(f"*/{RUN}")):
            what, fix = "the README.md of a folder without results is not replaced", "Choose a new folder as ENTRY."
            raise OutputExistsError(what, where=find_card(out), fix=fix)
        if not overwrite:
            fix = "Omit --card to keep it, or pass --overwrite."
            raise OutputExistsError("the entry has another model card", where=find_card(out), fix=fix)
    sample = list_stored_episodes(result, protocol)
    # a path of the author's machine means nothing to others
    parts = [part.model_copy(update={"folder": Path(part.folder).name}) for part in result.run.merged_from]
    run = result.run.model_copy(update={"merged_from": parts} if parts else {})
    with atomic_folder(out) as folder:
        write_json(folder / RUN, run.to_dict())
        for number in sample:
            write_actions(folder, number, result.read_actions(number))
            write_checkpoints(folder, number, result.read_checkpoints(number))
        write_outcomes(folder, result)
    if text is not None:
        with atomic_file(find_card(out)) as tmp:
            tmp.write_text(text, encoding="utf-8")
    return sample


def read_card(path: Path) -> str:
    """Read a model card."""
    try:
        return read_text(path, _CARD_BYTES)
    except (OSError, ValueError) as error:
        raise EvaluationError("cannot read the model card", where=path, found=error) from error
