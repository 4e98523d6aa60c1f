"""Readers of randomly changed files return a result or raise a RobocasError of one line."""

import json
import shutil
import warnings
from dataclasses import asdict
from pathlib import Path

import numpy as np
import pytest
import synthetic_results
from fuzzing import damage, flip_bits
from recorded_candidates import write_recorded_candidates
from synthetic import RayCaster, write_trajectory
from synthetic_candidates import write_episodes

from robocas_ms3.assets.annotations import Annotations
from robocas_ms3.assets.hulls import read_hulls
from robocas_ms3.assets.pack import load_pack
from robocas_ms3.baselines.training.record import BUNDLED, read_run
from robocas_ms3.core.documents import DocumentError
from robocas_ms3.core.errors import RobocasError
from robocas_ms3.core.json_lines import JsonLinesFile
from robocas_ms3.core.output_folder import OutputFolder
from robocas_ms3.core.paths import builtin_packs_dir, published_results_file
from robocas_ms3.core.poses import from_xyz_yaw
from robocas_ms3.datasets import CandidateDataset, CandidateOptions
from robocas_ms3.datasets.candidate_images.images_file import CandidateImages
from robocas_ms3.datasets.candidate_images.render import render_candidates
from robocas_ms3.datasets.candidate_images.settings import CandidateImageSettings
from robocas_ms3.datasets.checks.candidates import validate_candidates
from robocas_ms3.datasets.checks.dataset import validate
from robocas_ms3.datasets.conversion.convert import convert
from robocas_ms3.datasets.conversion.episode_plan import DATASET, make_settings, plan_episodes
from robocas_ms3.datasets.conversion.settings import ConversionSettings
from robocas_ms3.datasets.images.image_files import ImageOptions
from robocas_ms3.datasets.lerobot.check import check_lerobot
from robocas_ms3.datasets.lerobot.convert import convert_lerobot
from robocas_ms3.datasets.sources.provenance import make_recorded_scene, make_recording_entry
from robocas_ms3.datasets.sources.reader import Dataset
from robocas_ms3.datasets.sources.trajectory import TrajectorySource
from robocas_ms3.datasets.statistics.candidates import compute_candidate_statistics
from robocas_ms3.datasets.statistics.collect import collect_statistics
from robocas_ms3.demos.failures import FailedAttempt, count_by_reason
from robocas_ms3.demos.generation import OUTPUT
from robocas_ms3.demos.recordings.trajectory_file import TrajectoryFile
from robocas_ms3.demos.settings import EpisodeSettings
from robocas_ms3.demos.trajectory_replay import RecordedEpisode
from robocas_ms3.evaluation.leaderboard.rows import read_leaderboard
from robocas_ms3.evaluation.protocols.bundled_protocols import bundled_protocols
from robocas_ms3.evaluation.protocols.protocol import load_protocol
from robocas_ms3.evaluation.report.comparison import compare_results
from robocas_ms3.evaluation.report.page import render_page
from robocas_ms3.evaluation.report.tables import render_markdown
from robocas_ms3.evaluation.results import result_files
from robocas_ms3.plans.folder import OUTCOME, OUTCOMES, PLAN, Outcome, PlanFolder, WorkUnit, read_plan
from robocas_ms3.plans.load import bundled_plans, load_plan
from robocas_ms3.plans.status import read_status
from robocas_ms3.robots.cameras import STANDARD_CAMERA_NAMES
from robocas_ms3.scenes.layout import Layout
from robocas_ms3.scenes.layout_table import FrozenLayouts, LayoutTable, write_frozen_layouts, write_table
from robocas_ms3.viewer.routes import Routes
from robocas_ms3.viewer.source import open_content as open_page

PACK = builtin_packs_dir() / "builtin"
OBJECT = min(PACK.glob("*/annotations.npz")).parent
NAMES = ["one", "three", "two"]
LAYOUT = Layout(
    ("two", "one", "two"),
    np.stack([from_xyz_yaw(0.1 * i, 0.2, 0.6, i) for i in range(3)]),
    from_xyz_yaw(0.7, 0.15, 0, 1.5),
    from_xyz_yaw(1.3, 0.9, 0.6, 0),
    target=1,
)
RUN = {"settings": asdict(EpisodeSettings("pick")), "first_seed": 0, "versions": {"a": "1"}}
FAILURE = {"seed": 1, "attempt": 0, "stage": "a", "reason": "b", "seconds": 1.0}
ENTRY = {"trajectory": "F.h5", "trajectory_episode": 0, "seed": 3, "success": True, "recording": "ab", "source": 0}
CONVERSION = make_settings(5, ImageOptions(STANDARD_CAMERA_NAMES), False)


# What is whole at first: functions that write it into a folder


def write_robocas(root):
    trajectory = write_trajectory(root.with_suffix(".h5"), seeds=(3, 4))
    made = {"size": (64, 48), "video": False, "open_renderer": RayCaster, "embeddings": False}
    convert(ConversionSettings(trajectory, root, **made))


def write_lerobot(root):
    trajectory = write_trajectory(root.with_suffix(".h5"), seeds=(3, 4))
    convert_lerobot(ConversionSettings(trajectory, root, size=(64, 48), video=False, open_renderer=RayCaster))


def write_recording(root):
    root.mkdir()
    write_trajectory(root / "trajectory.h5", seeds=(3, 4))


def write_candidates(root):
    root.mkdir()
    write_episodes(root / "candidates.h5", seeds=(3,), decisions=1)


def write_candidate_images(root):
    root.mkdir()
    trajectory = write_trajectory(root / "trajectory.h5", seeds=(3,))
    candidates = write_recorded_candidates(root / "candidates.h5", trajectory, steps=(0, 8))
    render_candidates(CandidateImageSettings(candidates, open_renderer=RayCaster))


def write_pack(root):
    root.mkdir()
    manifest = json.loads((PACK / "manifest.json").read_text())
    (root / "manifest.json").write_text(json.dumps({**manifest, "assets": manifest["assets"][:2]}))
    for name in ("hulls.obj", "annotations.npz"):
        shutil.copy(OBJECT / name, root)
    (root / "hulls.obj").write_bytes((root / "hulls.obj").read_bytes()[:4000])


def write_protocol(root):
    shutil.copytree(Path(next(iter(bundled_protocols().values()))), root)


def write_result(root):
    synthetic_results.write(root, [synthetic_results.outcome(i, came_to=7 - i) for i in range(3)])


def write_published_rows(root):
    root.mkdir()
    shutil.copy(published_results_file(), root / "rows.json")


COMPLETE, STARTED = WorkUnit(0, 0), WorkUnit(0, 1)


def plan_folder(root):
    return PlanFolder(load_plan(next(iter(bundled_plans()))), root)


def first_seed(folder):
    """Return the files of the first seed of the started work unit."""
    return folder.seed_files(STARTED, STARTED.seeds(folder.plan)[0]).folder


def write_plan(root):
    folder = plan_folder(root)
    for unit in (COMPLETE, STARTED):
        for seed in unit.seeds(folder.plan):
            with folder.seed_files(unit, seed).temporary_files() as files:
                files.write_outcome(Outcome(seed, True, 10, ["a: b"], ["c: d"], 1.0, 1.0, 5, 1e9))
    folder.write_outcomes(COMPLETE)
    (root / PLAN).write_text(json.dumps(folder.make_record()))
    shutil.copy(folder.unit_folder(COMPLETE) / OUTCOMES, root)  # where the table below finds them
    shutil.copy(first_seed(folder) / OUTCOME, root)


def write_generation(root):
    root.mkdir()
    (root / "run.json").write_text(json.dumps(RUN))
    (root / "failures.jsonl").write_text(json.dumps(FAILURE))


def write_conversion(root):
    root.mkdir()
    whole = {"schema_version": 2, "made_with": {}, **CONVERSION, "episodes": {"0": ENTRY}}
    (root / "conversion.json").write_text(json.dumps(whole))
    (root / "episode_0000000").write_text("an episode")


def write_training(root):
    shutil.copytree(BUNDLED / "small", root)


def write_layouts(root):
    root.mkdir()
    write_table(root / "table.npy", NAMES, dict.fromkeys([(0, 0), (0, 1)], LAYOUT))
    write_frozen_layouts(root / "frozen.npy", NAMES, {0: LAYOUT})


# Readers of such folders


def read_dataset(root):
    dataset = Dataset(root)
    for side in ("train", "val", "all"):
        dataset.split(side)
    for number in dataset.numbers[:1]:
        episode = dataset.episode(number)
        assert episode.arrays
        assert episode.goals is not None
        assert episode.layout is not None


def read_recording(root):
    """Read a recording as conversion, statistics, viewer and replay do."""
    path = root / "trajectory.h5"
    with TrajectoryFile(path) as file:
        for index in range(len(file.episodes)):
            recording = file.read_recording(index)
            motion = recording.compute_motion(np.arange(0, recording.control_steps + 1, 4))
            assert np.isfinite(motion.actions).all()
            assert np.isfinite(RecordedEpisode.read(path, file.episodes[index]).actions).all()
            assert make_recording_entry(file, index)
            assert make_recorded_scene(file, index)
    source = TrajectorySource(path)
    for number in source.numbers:
        episode = source.episode(number)
        assert episode.arrays
        _ = episode.goals, episode.scene, episode.layout, source.conversion_entry(number)


def read_candidates(root):
    """Read candidates as the validator, statistics and training do."""
    validate_candidates(root / "candidates.h5")
    dataset = CandidateDataset(root, CandidateOptions(split="all"))
    assert dataset.files[0].labels.benefit.shape == dataset.files[0].candidates["displacement"].shape
    for index in range(len(dataset)):
        assert dataset[index]["mask"].any()
        assert dataset.files[0].state(index)["actors"]
    with np.errstate(all="ignore"):
        compute_candidate_statistics([root / "candidates.h5"])


def read_candidate_images(root):
    images = CandidateImages(root / "candidates_images.h5")
    for camera in images.cameras:
        for row in (0, 1):
            _ = images.rgb(row, camera), images.depth(row, camera), images.intrinsic(row, camera)
            _ = images.camera_in_base(row, camera)


def show_decisions(root):
    """Request all answers of the viewer for decisions except images."""
    content = open_page(root / "candidates.h5")
    with np.errstate(all="ignore"):
        for entry in content.index()["episodes"]:
            content.episode(entry["n"])


def show_page(root):
    """Request all answers of the viewer except images."""
    routes = Routes(open_page(root))
    assert routes.respond("/data/index.js").status == 200
    for number in (0, 1):
        assert routes.respond(f"/data/episode_{number}.js").status in (200, 404)


def read_annotations(root):
    with warnings.catch_warnings():
        warnings.simplefilter("error", RuntimeWarning)
        notes = Annotations.load(root / "annotations.npz")
    assert np.isfinite(notes.grasps_tcp_in_object).all()
    assert -1 <= notes.display_pose < len(notes.resting_poses)


def read_hull_file(root):
    for hull in read_hulls(root / "hulls.obj"):
        assert np.isfinite(hull.vertices).all()
        assert 0 <= hull.faces.min() <= hull.faces.max() < len(hull.vertices)


def read_result(root):
    found = result_files.read_result(root)
    assert render_markdown(found)
    assert render_page(found)
    assert compare_results([found, found])
    result_files.group_partial_results([root])


def read_plan_folder(root):
    folder = plan_folder(root)
    shutil.copy(root / OUTCOMES, folder.unit_folder(COMPLETE))
    shutil.copy(root / OUTCOME, first_seed(folder))
    assert read_status(root)
    read_plan(root).open_output(shared=True).check_record()


def read_generation(root):
    OutputFolder(root, OUTPUT, RUN).read_record()
    count_by_reason(JsonLinesFile(root / "failures.jsonl", FailedAttempt).read())


def read_conversion(root):
    output = OutputFolder(root, DATASET, CONVERSION)
    output.read_record()
    plan_episodes(output, [ENTRY], CONVERSION, append=False)


def read_table(root):
    table = LayoutTable(root / "table.npy", NAMES)
    found = [table.layout(pair) for pair in ((0, 0), (0, 1))]
    assert table.object_ids(0) is None or set(table.object_ids(0)) <= set(NAMES)
    for layout in filter(None, found):
        layout.check(NAMES)


def read_frozen(root):
    layout = FrozenLayouts(root / "frozen.npy", NAMES)(0, 0)
    if layout is not None:
        layout.check(NAMES)


ROBOCAS_FILES = ("data_info.json", "conversion.json", "episode_0000000/scene.json")
CASES = [  # writer, file, reader, number of changed files, least number of errors
    *((write_robocas, name, read, 16, 0) for read in (validate, read_dataset) for name in ROBOCAS_FILES),
    (write_robocas, "episode_0000000/episode_info.npz", read_dataset, 16, 0),
    *((write_lerobot, f"meta/{name}.json", check_lerobot, 10, 0) for name in ("info", "stats", "robocas/conversion")),
    *((write_robocas, name, show_page, 16, 0) for name in ROBOCAS_FILES),
    (write_recording, "trajectory.json", show_page, 40, 0),
    (write_recording, "trajectory.h5", read_recording, 80, 20),
    (write_recording, "trajectory.json", read_recording, 120, 30),
    (write_candidates, "candidates.h5", read_candidates, 80, 20),
    (write_candidate_images, "candidates_images.h5", read_candidate_images, 120, 10),
    (write_candidate_images, "candidates.h5", show_decisions, 80, 20),
    (write_candidate_images, "candidates_images.h5", show_decisions, 40, 0),
    (write_recording, "trajectory.json", lambda root: collect_statistics(root / "trajectory.h5"), 20, 0),
    (write_pack, "manifest.json", load_pack, 150, 120),
    (write_pack, "hulls.obj", read_hull_file, 40, 10),
    (write_pack, "annotations.npz", read_annotations, 80, 40),
    *((write_protocol, name, load_protocol, 30, 0) for name in ("protocol.yaml", "episodes.jsonl")),
    (write_result, result_files.RUN, read_result, 40, 5),
    (write_result, result_files.OUTCOMES, read_result, 40, 0),
    (write_result, "actions/000000.npz", lambda root: result_files.read_result(root).read_actions(0), 80, 40),
    (write_published_rows, "rows.json", lambda root: read_leaderboard(root / "rows.json"), 60, 20),
    (write_plan, PLAN, read_plan_folder, 25, 5),
    *((write_plan, name, read_plan_folder, 20, 0) for name in (OUTCOMES, OUTCOME)),
    (write_generation, "run.json", read_generation, 60, 10),
    (write_generation, "failures.jsonl", read_generation, 60, 0),
    (write_conversion, "conversion.json", read_conversion, 60, 10),
    (write_training, "run.json", read_run, 40, 10),
    (write_layouts, "table.npy", read_table, 50, 25),
    (write_layouts, "frozen.npy", read_frozen, 50, 25),
]


def raises_error(read, path, case):
    try:
        read(path)
    except (RobocasError, DocumentError) as error:
        assert "\n" not in str(error), case
        return True
    except Exception as error:
        raise AssertionError(case) from error
    return False


@pytest.fixture(scope="module")
def folder_of(tmp_path_factory):
    """Return a function that returns the folder of a writer; each writer runs once."""
    kept = {}

    def of(write):
        if write not in kept:
            kept[write] = tmp_path_factory.mktemp("whole") / write.__name__
            write(kept[write])
        return kept[write]

    return of


@pytest.mark.parametrize(("write", "name", "read", "count", "least"), CASES)
def test_file_is_read_or_an_error(folder_of, tmp_path, write, name, read, count, least):
    root = shutil.copytree(folder_of(write), tmp_path / "copy")
    if read is not load_pack:
        assert not raises_error(read, root, "whole")
    whole, errors = (root / name).read_bytes(), 0
    for seed in range(count):
        (root / name).write_bytes(damage(name, whole, seed))
        errors += raises_error(read, root, seed)
    assert errors >= least


def test_damaged_images_and_arrays_are_violations(folder_of, tmp_path):
    root = shutil.copytree(folder_of(write_robocas), tmp_path / "copy")
    for name in ("episode_info.npz", "base_camera/intrinsic.npy", "base_camera/rgb/0001.png"):
        path = root / "episode_0000000" / name
        whole, found = path.read_bytes(), 0
        for seed in range(12):
            path.write_bytes(flip_bits(whole, seed))
            found += bool(validate(root).violations)
        assert found > 6
        path.write_bytes(whole)
