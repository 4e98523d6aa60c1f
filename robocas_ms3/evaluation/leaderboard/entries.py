"""Entries of the leaderboard: folders with the results of a policy.

::

    keyframe/README.md    model card
    keyframe/paper-v1/    result of `robocas eval` with the stored actions of a sample of its episodes only

The hashes of the actions of all episodes are in ``episodes.jsonl``.
"""

from __future__ import annotations

import hashlib
from pathlib import Path

from robocas_ms3.core.errors import EvaluationError
from robocas_ms3.core.files import atomic_folder, write_json
from robocas_ms3.core.output_folder import check_replaceable
from robocas_ms3.core.text import format_count
from robocas_ms3.evaluation.protocol import LoadedProtocol
from robocas_ms3.evaluation.results import RUN, Result, write_outcomes
from robocas_ms3.evaluation.stored_episodes import write_actions
from robocas_ms3.evaluation.verify import find_violations

SAMPLE_SIZE = 50
"""Number of episodes of a result whose actions are in an entry."""


def choose_sample(result: Result) -> list[int]:
    """Return the numbers of the episodes whose actions are in an entry, in ascending order.

    The protocol fixes the sample: it has the episodes with the smallest hashes of protocol and number.
    """

    def compute_hash(number: int) -> bytes:
        return hashlib.sha256(f"{result.run.protocol_hash} {number}".encode()).digest()

    return sorted(sorted(result.outcomes, key=compute_hash)[:SAMPLE_SIZE])


def write_result(result: Result, protocol: LoadedProtocol, out: Path, *, overwrite: bool = False) -> list[int]:
    """Write a result into a folder of an entry, and return the numbers of the episodes of the sample.

    Args:
        result: the result. It may lack episodes of the protocol.
        protocol: its protocol.
        out: new folder, such as ``leaderboard/keyframe/paper-v1``; written atomically.
        overwrite: whether to replace an existing result.

    Raises:
        EvaluationError: the result has violations (`find_violations`).
        OutputExistsError: ``out`` exists.
    """
    if violations := find_violations(result, protocol, is_complete=False):
        what, fix = "the result has violations", "Run robocas eval verify to list all."
        found = f"{format_count(len(violations), 'violation')}, the first: {violations[0]}"
        raise EvaluationError(what, where=result.folder, found=found, fix=fix)
    check_replaceable(out, overwrite=overwrite, markers=(RUN,))
    sample = choose_sample(result)
    with atomic_folder(out) as folder:
        write_json(folder / RUN, result.run.to_dict())
        for number in sample:
            write_actions(folder, number, result.read_actions(number))
        write_outcomes(folder, result)
    return sample
