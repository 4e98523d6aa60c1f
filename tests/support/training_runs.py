"""Change and compare training runs."""

import csv
import json

import torch
from safetensors.torch import load_file

from robocas_ms3.baselines.training.session import ProgressCallbacks, RunOptions, train_run


def train(name, data, out, changes=None, *, progress=None, device="cpu", **options):
    return train_run(RunOptions(name, data, out, changes or {}, device=device, **options), progress)


def stop_at(step, error):
    """Return a progress object that raises an error at a step."""

    def report(done, total):
        if done == step:
            raise error

    return ProgressCallbacks(on_step=report)


def read_log(folder, split=None):
    """Return the rows of the log without the column of times."""
    with (folder / "metrics.csv").open() as file:
        rows = [{k: v for k, v in row.items() if k != "seconds"} for row in csv.DictReader(file)]
    return [row for row in rows if split in (None, row["split"])]


def assert_same(one, other):
    for name in ("weights.safetensors", "checkpoint.safetensors"):
        first, second = load_file(one / name), load_file(other / name)
        assert first.keys() == second.keys()
        assert all(torch.equal(first[key], second[key]) for key in first), name
    assert read_log(one) == read_log(other)
    first, second = ((folder / "metrics.csv").read_text().partition("\n")[0] for folder in (one, other))
    assert first == second


def assert_finite(folder):
    for name in ("weights", "checkpoint"):
        assert all(tensor.isfinite().all() for tensor in load_file(folder / f"{name}.safetensors").values())


def fit(baseline, config, samples, steps):
    """Train a network on all samples at once; return it and the loss of each step."""
    torch.manual_seed(0)
    model = baseline.model(config, samples.facts).train()
    batch = samples.__getitems__(list(range(len(samples))))
    optimizer, losses = torch.optim.AdamW(model.parameters(), lr=8e-3), []
    for _ in range(steps):
        loss = model(batch)["loss"]
        losses.append(loss.item())
        optimizer.zero_grad()
        loss.backward()
        torch.nn.utils.clip_grad_norm_(model.parameters(), config.train.clip_norm)
        optimizer.step()
    return model.eval(), losses


def change_record(run, **values):
    path = run / "run.json"
    path.write_text(json.dumps({**json.loads(path.read_text()), **values}))
