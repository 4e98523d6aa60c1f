"""Files of unknown origin are read whole, or refused by one typed error of one line, whatever values they hold."""

import json
import shutil

import pytest
from fuzzing import VALUES, changed
from synthetic import write_trajectory

from robocas_ms3.core.documents import DocumentError
from robocas_ms3.core.errors import RobocasError, TrainingError
from robocas_ms3.core.ledger import Ledger
from robocas_ms3.core.outputs import OutputFolder
from robocas_ms3.datasets.pictures.stored import Pictures
from robocas_ms3.datasets.sources.provenance import recorded_scene, recording_entry
from robocas_ms3.datasets.sources.trajectory import TrajectorySource
from robocas_ms3.datasets.statistics.collect import collect
from robocas_ms3.datasets.writing.plan import DATASET, dataset_settings, plan_episodes
from robocas_ms3.demos.generate import OUTPUT
from robocas_ms3.demos.ledger import Failure, count_by_stage
from robocas_ms3.demos.recordings.reading import TrajectoryFile
from robocas_ms3.plans.folder import PLAN, check_plan_record, plan_record, read_plan
from robocas_ms3.plans.load import load_plan, shipped_plans
from robocas_ms3.plans.status import read_status
from robocas_ms3.plans.units import OUTCOME, OUTCOMES, Outcome, Unit
from robocas_ms3.robots.cameras import STANDARD_NAMES

MOST = 40  # changes of a file that are tried: the same ones each time


def refused(read, path, whole, *, line=False, most=MOST):
    """Read a file with every change, and return the places whose change was refused."""
    before = path.read_text() if path.exists() else ""
    rest = before.splitlines(keepends=True)[1:] if line else []
    places = set()
    for place, value, data in [*changed(whole, most), *(((), value, value) for value in VALUES[::5])]:
        path.write_text("".join([json.dumps(data), "\n" * line, *rest]))
        try:
            read()
        except (RobocasError, DocumentError) as error:
            assert "\n" not in str(error)
            places.add(place)
        except Exception as error:
            raise AssertionError(f"{place}: {str(value)[:40]}") from error
    path.write_text(before)
    return places


def test_files_of_a_plan(tmp_path):
    plan, out = load_plan(next(iter(shipped_plans()))), tmp_path / "plan"
    complete, started = Unit(0, 0), Unit(0, 1)
    for unit in (complete, started):
        for seed in unit.seeds(plan):
            with unit.files(plan, out, seed).temporary() as files:
                files.write(Outcome(seed, True, 10, ["a: b"], ["c: d"], 1.0, 1.0, 5, 1e9))
    complete.complete(plan, out)
    (out / PLAN).write_text(json.dumps(plan_record(plan)))

    def read():
        assert read_status(out)
        check_plan_record(out, read_plan(out))

    read()
    assert refused(read, out / PLAN, plan_record(plan), most=25)
    path = complete.folder(plan, out) / OUTCOMES  # damaged files are left out
    refused(read, path, json.loads(path.read_text().splitlines()[0]), line=True, most=20)
    path = started.files(plan, out, started.seeds(plan)[0]).folder / OUTCOME
    refused(read, path, json.loads(path.read_text()), most=20)


def test_files_of_a_generation(tmp_path):
    run = {"env_id": "x", "settings": {"task": "pick", "control_freq": 20}, "versions": {"a": "1"}, "seed": 0}
    path = tmp_path / "run.json"
    path.write_text(json.dumps(run))
    ledger = Ledger(tmp_path / "failures.jsonl", Failure)
    failure = {"seed": 1, "attempt": 0, "stage": "a", "reason": "b", "seconds": 1.0}
    ledger.path.write_text(json.dumps(failure) + "\n")
    assert refused(lambda: OutputFolder(tmp_path, OUTPUT, run).read(), path, run)
    refused(lambda: count_by_stage(ledger.read()), ledger.path, failure, line=True)
    for changes in ({"attempt": -2}, {"seed": 2**62}, {"seconds": 1e308}, {"seconds": True}):
        ledger.path.write_text(json.dumps({**failure, **changes}) + "\n")
        assert ledger.read() == []


def test_the_json_of_a_trajectory(tmp_path):
    path = write_trajectory(tmp_path / "trajectory.h5", seeds=(3, 4))

    def read():
        source = TrajectorySource(path)
        for number in source.numbers:
            episode = source.episode(number)
            assert episode.arrays
            _ = episode.goals, episode.scene, episode.layout, source.entry(number)
        collect(path)
        with TrajectoryFile(path) as file:
            for index in range(len(file.episodes)):
                assert recording_entry(file, index)
                assert recorded_scene(file, index)

    read()
    whole = json.loads(path.with_suffix(".json").read_text())
    assert refused(read, path.with_suffix(".json"), whole, most=25)


def test_the_settings_of_a_conversion_that_continues(tmp_path):
    entry = {"trajectory": "F.h5", "trajectory_episode": 0, "seed": 3, "success": True, "recording": "ab", "source": 0}
    settings = dataset_settings(5, Pictures(STANDARD_NAMES), False)
    (tmp_path / "episode_0000000").write_text("an episode")
    whole = {"schema_version": 2, "made_with": {}, **settings, "episodes": {"0": entry}}

    def read():
        output = OutputFolder(tmp_path, DATASET, settings)
        output.read()
        plan_episodes(output, [entry], settings, append=False)

    assert refused(read, tmp_path / "conversion.json", whole)


torch = pytest.importorskip("torch", reason="needs torch")


def test_a_training_run_and_its_checkpoint(tmp_path):
    from safetensors.torch import save_file

    from robocas_ms3.baselines.policy import RunPolicy
    from robocas_ms3.baselines.training import checkpoints
    from robocas_ms3.baselines.training.record import BUNDLED, read_run

    root = shutil.copytree(BUNDLED / "small", tmp_path / "run")
    whole = json.loads((root / "run.json").read_text())
    assert refused(lambda: read_run(root), root / "run.json", whole)
    facts = whole["facts"]
    for changes in ({"chunk": {**facts["chunk"], "mean": "x"}}, {"heights": []}, {"pictures": {"base_camera": [1]}}):
        (root / "run.json").write_text(json.dumps({**whole, "facts": {**facts, **changes}}))
        with pytest.raises(TrainingError):
            RunPolicy(root, "cpu")
    (root / "run.json").write_text(json.dumps(whole))
    small = root / "small.safetensors"
    for metadata in ({"step": ""}, {"step": "-1"}, {"step": "nan"}, {"step": "1e308"}, {"step": "9" * 5000}, {}):
        save_file({"a": torch.zeros(1)}, small, metadata)
        with pytest.raises(TrainingError) as error:
            checkpoints.load(small, {})
        assert len(str(error.value)) < 500
