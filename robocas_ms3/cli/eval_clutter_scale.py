"""``robocas eval clutter-scale``: place policies on a scale of the difficulty of scenes."""

from __future__ import annotations

from dataclasses import dataclass
from math import isfinite
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import tyro

from robocas_ms3.cli.options import Folders, Maybe

if TYPE_CHECKING:
    from robocas_ms3.evaluation.clutter_scale.curves import SuccessCurve


@dataclass(kw_only=True)
class PlacePolicies:
    """Place policies on a scale of the difficulty of scenes: the difficulty that they solve half of the time.

    Each task has its own scale, from 0 (easiest scene of the protocol) to 10 (hardest scene). clutter-scale-v1 has a
    fixed scale of pick. Without a fixed scale, or with --fit, it is fitted to the policies with 10 to 90 % success in
    the task; at least two are necessary. Writes clutter_scale.json, curves.json and clutter_scale.png, and replaces
    existing ones.

    Example: robocas eval clutter-scale eval/mine --out eval/scale
    """

    folders: Folders
    """Folders of results on one protocol; shards of one evaluation count as one result."""
    protocol: Annotated[Maybe[str], tyro.conf.arg(metavar="PROTOCOL")] = None
    """Protocol folder. Required if the protocol of the results is not bundled."""
    fit: bool = False
    """Fit the scale to these results, also if the protocol has a fixed scale."""
    out: Path
    """Output folder."""


def clutter_scale(cfg: PlacePolicies) -> int:
    from robocas_ms3.cli.eval_results import read_evaluations
    from robocas_ms3.cli.terminal import print_line, print_table
    from robocas_ms3.core.errors import require_extra
    from robocas_ms3.core.files import make_folder

    require_extra("clutter-scale", "the clutter scale", "sklearn")
    require_extra("plots", "the plot of the clutter scale", "matplotlib")
    from robocas_ms3.evaluation.clutter_scale.figure import write_curves
    from robocas_ms3.evaluation.clutter_scale.scale_file import SCALE_FILE
    from robocas_ms3.evaluation.clutter_scale.study import describe_counts, make_study
    from robocas_ms3.evaluation.results.result_files import load_protocol_of

    results = read_evaluations(cfg.folders)
    protocol = load_protocol_of(results[0], cfg.protocol)
    study = make_study(results, protocol, fit=cfg.fit)
    make_folder(cfg.out)
    study.write(cfg.out)
    write_curves(study, cfg.out / "clutter_scale.png")
    for name, task in study.tasks.items():
        rows = [
            (
                policy.name,
                policy.track,
                f"{policy.curve.successes}/{policy.curve.episodes}",
                _describe_half(policy.curve),
                "" if policy.auc is None else f"{policy.auc:.2f}",
            )
            for policy in task.policies
        ]
        print_table(("policy", "track", f"success in {name}", "difficulty at 50 % (95 % interval)", "AUC"), rows)
        weights = sorted(task.standard_weights.items(), key=lambda item: -abs(item[1]))
        rows = [(feature, f"{weight:.2f}") for feature, weight in weights]
        print_table((f"feature in {name}", "difficulty per standard deviation"), rows)
        if task.mean_auc is not None and not study.is_fixed:
            print_line(f"{name}: mean AUC in scenes that were not used for the fit: {task.mean_auc:.2f}")
    for name, counts in study.left_out.items():
        reason = (
            "the protocol has none (--fit fits one)" if study.is_fixed else "too few policies have 10 to 90 % success"
        )
        print_line(f"{name}: no scale, because {reason}: {describe_counts(counts)}")
    print_line(
        "difficulty: 0 is the easiest scene of the protocol, 10 the hardest; none: success does not fall with the "
        "difficulty. AUC: probability that a failed scene is more difficult than a solved one; 0.5: no relation"
    )
    hashes = ", ".join(f"{name} {digest[:8]}" for name, digest in study.file_hashes.items())
    if study.is_fixed:
        print_line(f"scale: the fixed one of {protocol.rules.name} (sha256: {hashes}); to fit another, pass --fit")
    else:
        print_line(f"scale: fitted to these results on {protocol.rules.name} (sha256: {hashes})")
    print_line("not audited: the outcomes are consistent with the protocol, but no stored actions were replayed")
    print_line(f"wrote {SCALE_FILE}, curves.json and clutter_scale.png to {cfg.out}")
    return 0


def _describe_half(curve: SuccessCurve) -> str:
    from robocas_ms3.evaluation.clutter_scale.item_response import HARDEST

    if curve.half is None:
        return "none"
    if not 0 <= curve.half <= HARDEST:
        return f"above {HARDEST:.0f}" if curve.half > HARDEST else "below 0"
    if not (isfinite(curve.low) and isfinite(curve.high)):
        return f"{curve.half:.1f} (no limits: the slope is not significant)"
    return f"{curve.half:.1f} ({curve.low:.1f} to {curve.high:.1f})"
