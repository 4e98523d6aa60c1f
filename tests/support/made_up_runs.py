"""What tests of runs do to them, and compare of them."""

import csv
import json

import torch
from safetensors.torch import load_file

from robocas_ms3.baselines.session import Said


def stop_at(step, error):
    def look(done, of):
        if done == step:
            raise error

    return Said(step=look)


def lines(folder):
    """Lines of the log, but for the clock's column."""
    with (folder / "metrics.csv").open() as file:
        return [{k: v for k, v in row.items() if k != "seconds"} for row in csv.DictReader(file)]


def assert_same(one, other):
    for name in ("weights.safetensors", "checkpoint.safetensors"):
        first, second = load_file(one / name), load_file(other / name)
        assert first.keys() == second.keys()
        assert all(torch.equal(first[key], second[key]) for key in first), name
    assert lines(one) == lines(other)
    first, second = ((folder / "metrics.csv").read_text().partition("\n")[0] for folder in (one, other))
    assert first == second


def say(run, **values):
    path = run / "run.json"
    path.write_text(json.dumps({**json.loads(path.read_text()), **values}))
