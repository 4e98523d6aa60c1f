"""Content of the page for a candidates file: list of decisions, decisions with their candidates, images."""

from __future__ import annotations

import threading
from collections import Counter
from dataclasses import asdict
from typing import Any

import numpy as np
from numpy.typing import NDArray

from robocas_ms3.core.errors import DatasetError
from robocas_ms3.datasets.sources.provenance import parse_task_name
from robocas_ms3.demos.candidates.candidates_file import Decision
from robocas_ms3.viewer.content import CAMERA_NAME, Content
from robocas_ms3.viewer.damage import convert_damage_errors
from robocas_ms3.viewer.decisions.decision_source import DecisionSource, DecisionView, choose_view
from robocas_ms3.viewer.decisions.outcomes import COLOURS, OUTCOMES
from robocas_ms3.viewer.episode import round_values
from robocas_ms3.viewer.episode_table import Row
from robocas_ms3.viewer.images import EncodedImage, encode_jpeg

_PIXEL_DECIMALS = 1
_TARGET_FIELDS = ("obstacles", "free_grasps", "hidden_fraction")


class DecisionContent(Content):
    """Content of the page for one candidates file; the number of an episode on the page is the row of a decision."""

    def __init__(self, source: DecisionSource) -> None:
        self.source, self.root = source, source.file.path
        self._reading = threading.Lock()

    def index(self) -> dict[str, Any]:
        images, file = self.source.images, self.source.file
        env = str(file.env_info.get("env_id", ""))
        path = self.root.resolve()
        return {
            "name": f"{path.parent.name}/{path.name}",
            "kind": f"candidates of {(parse_task_name(env) or env).replace('_', ' ')}",
            "cameras": [name for name in images.cameras if CAMERA_NAME.fullmatch(name)] if images else [],
            "depth": bool(images and images.has_depth),
            "note": self.source.note,
            "decisions": True,
            "outcomes": {name: "#{:02x}{:02x}{:02x}".format(*COLOURS[name]) for name in OUTCOMES},
            "episodes": [asdict(self._make_row(row)) for row in range(len(self.source))],
        }

    def episode(self, number: int) -> dict[str, Any]:
        with convert_damage_errors(f"{self.root.name}, decision {number}"):
            return self._make_content(number)

    def _make_content(self, number: int) -> dict[str, Any]:
        decision, views = self.source.decision(number), self.source.views(number)
        values = decision.values
        return {
            "n": number,
            "steps": 1,
            "instruction": str(values["instruction"]),
            "kind": str(values["kind"]),
            "seed": int(values["seed"]),
            "decision": int(values["decision"]),
            "step": int(values["step"]),
            "facts": self._collect_facts(decision),
            "views": [_make_view(view) for view in views],
            "best_view": choose_view(views).view.name,
            "candidates": self._list_candidates(decision),
        }

    def rgb(self, number: int, camera: str, step: int) -> EncodedImage:
        with convert_damage_errors(f"{self.root.name}, decision {number}"), self._reading:
            return encode_jpeg(self._images(step).rgb(number, camera))

    def depth(self, number: int, camera: str, step: int) -> NDArray[np.uint16]:
        with convert_damage_errors(f"{self.root.name}, decision {number}"), self._reading:
            return self._images(step).depth(number, camera)

    def _images(self, step: int):
        if self.source.images is None or step != 0:
            raise DatasetError("no such image", where=self.root)
        return self.source.images

    def _make_row(self, number: int) -> Row:
        file, rows = self.source.file, self.source.file.rows_of(number)
        values = {name: file.decisions[name][number] for name in ("seed", "kind", "in_episode")}
        undone = "" if values["in_episode"] else ", undone attempt"
        counts = Counter(self.source.outcomes[rows].tolist())
        found = ", ".join(f"{counts[name]} {name}" for name in reversed(OUTCOMES) if counts[name])
        chosen = np.flatnonzero(file.candidates["chosen"][rows])
        return Row(
            number,
            steps=rows.stop - rows.start,
            instruction=f"seed {values['seed']}{undone}: {found or 'no candidates'}",
            task=str(values["kind"]),
            object=self.source.name_object(file.decision(number), int(file.decisions["target_slot"][number])),
            seed=int(values["seed"]),
            success=bool(file.candidates["success"][rows][chosen[0]]) if len(chosen) else None,
            stages=sorted(set(file.candidates["primitive"][rows].tolist())),
        )

    def _collect_facts(self, decision: Decision) -> dict[str, Any]:
        """Return values of a decision that the page lists below the table, by title."""
        values, target = decision.values, int(decision.values["target_slot"])
        held = int(values["held_slot"])
        facts: dict[str, Any] = {
            title: self.source.name_object(decision, slot, with_id=True)
            for title, slot in (("Target", target), ("Held object", held))
        }
        if 0 <= target < len(values["present"]):
            facts |= {
                "Obstacles of the target": int(values["obstacles"][target]),
                "Free grasps of the target": int(values["free_grasps"][target]),
                "Hidden share of the target": f"{100 * values['hidden_fraction'][target]:.0f} %",
            }
        if values["attempt"] or not values["in_episode"]:
            facts["Attempt"] = f"{values['attempt'] + 1}{'' if values['in_episode'] else ', failed later and undone'}"
        if np.isfinite(values["opening"]):
            facts["Opening"] = f"{100 * values['opening']:.0f} %"
        facts["Gripper width"] = f"{1000 * values['gripper_width']:.0f} mm"
        return {title: value for title, value in facts.items() if value != ""}

    def _list_candidates(self, decision: Decision) -> list[dict[str, Any]]:
        rows = self.source.file.rows_of(decision.row)
        values, target = decision.candidates, int(decision.values["target_slot"])
        known = 0 <= target < len(decision.values["present"])
        labels = self.source.file.labels
        benefit = labels.for_target(labels.benefit)[rows] if known else np.full(rows.stop - rows.start, np.nan)
        listed = []
        for index, outcome in enumerate(self.source.outcomes[rows].tolist()):
            after = {name: values[name][index, target] for name in _TARGET_FIELDS} if known else {}
            before = {name: decision.values[name][target] for name in after}
            listed.append(
                {
                    "n": index,
                    "outcome": outcome,
                    "object": self.source.name_object(decision, int(values["slot"][index])),
                    **{name: str(values[name][index]) for name in ("primitive", "source", "failure")},
                    **{name: bool(values[name][index]) for name in ("chosen", "held")},
                    **{name: round_values([before[name], after[name]]) for name in after},
                    "benefit": round_values(benefit[index]),
                    "target_mm": round_values(1000 * values["displacement"][index, target]) if known else None,
                    "disturbed": int(values["disturbed"][index]),
                    "fallen": int(values["fallen"][index].sum()),
                    "seconds": round_values(values["seconds"][index]),
                    "moves_to_grasp": int(values["moves_to_grasp"][index]),
                }
            )
        return listed


def _make_view(shown: DecisionView) -> dict[str, Any]:
    """Return a view as JSON values, in pixels."""
    return {
        "name": shown.view.name,
        "size": list(shown.view.size),
        "region": np.round(shown.region, _PIXEL_DECIMALS).tolist(),
        "candidates": [
            [{"points": _round_pixels(line.pixels), "dashed": line.dashed} for line in lines]
            for lines in shown.candidates
        ],
        "objects": [
            {
                "name": thing.name,
                "target": thing.target,
                "pixel": _round_pixels(thing.pixel) if np.isfinite(thing.pixel).all() else None,
                "outline": _round_pixels(thing.outline),
            }
            for thing in shown.objects
        ],
    }


def _round_pixels(pixels: NDArray[np.float64]) -> list:
    return (np.round(pixels, _PIXEL_DECIMALS) + 0.0).tolist()
