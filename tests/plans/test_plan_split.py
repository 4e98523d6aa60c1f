"""Training and validation episodes of a plan: by part, by rule, or as `robocas convert`."""

import json

import pytest
from plan_stages import PLAN

from robocas_ms3.datasets.manage import split
from robocas_ms3.datasets.sources.split import SPLIT_RULE
from robocas_ms3.plans import join as splits
from robocas_ms3.plans.plan import Plan

COUNTS = (20, 5, 10)


def plan_of(*splits, split=None):
    parts = [
        {"task": task, "episodes": count, "seed": 100 * number, "name": name, "split": side}
        for number, (task, count, name, side) in enumerate(
            zip(("pick", "select", "pick"), COUNTS, "abc", splits, strict=True)
        )
    ]
    return Plan.model_validate({**json.loads(PLAN.model_dump_json()), "parts": parts, "split": split}, strict=False)


@pytest.fixture
def of(monkeypatch):
    """Return a function that splits a plan, with given seeds, targets and tasks of its episodes."""

    def groups(root, by):
        numbers = range(sum(COUNTS))
        task = {n: "select" if 20 <= n < 25 else "pick" for n in numbers}
        return {"seed": {n: str(7 * n) for n in numbers}, "target": {n: str(n % 4) for n in numbers}, "task": task}[by]

    monkeypatch.setattr(splits, "group_episodes", groups)
    monkeypatch.setattr(splits, "Dataset", lambda root: root)
    return lambda plan: splits.split_episodes(plan, "somewhere")


def test_default_is_the_split_of_convert(of):
    plan = plan_of(None, None, None)
    assert of(plan) == splits.split_by_seed({n: 7 * n for n in range(35)})
    assert len(of(plan)[1]) == 4  # round(3.5)
    assert splits.describe_split(plan) == SPLIT_RULE


def test_split_of_a_part(of):
    plan = plan_of("train", "val", "train")
    assert of(plan) == ([*range(20), *range(25, 35)], [*range(20, 25)])
    assert splits.describe_split(plan) == "a: train; b: val; c: train"


def test_other_parts_are_split_by_the_rule(of):
    plan = plan_of(None, "val", None, split={"val_fraction": 0.2, "group_by": "target"})
    train, val = of(plan)
    assert sorted(train + val) == [*range(35)]
    assert set(range(20, 25)) < set(val)
    free = set(val) - set(range(20, 25))
    assert {n % 4 for n in free}.isdisjoint({n % 4 for n in train})  # a target is on one side
    assert splits.describe_split(plan) == f"b: val; {split.SplitOptions(0.2, 'target').rule}"


def test_episodes_of_a_single_group_are_for_training(of, caplog):
    plan = plan_of(None, "val", None, split={"group_by": "seed"})
    plan = plan.model_copy(
        update={"split": plan.split.model_copy(update={"group_by": "task"})}
    )  # parts of pick alone are free
    train, val = of(plan)
    assert (len(train), val) == (30, [*range(20, 25)])
    assert "all episodes have the same task" in caplog.text
