"""The stage `layouts` stores the layouts that environments sample."""

import numpy as np
import pytest
from plan_stages import PLAN

from robocas_ms3.assets.pack import load_pack
from robocas_ms3.core.errors import LayoutError
from robocas_ms3.plans.folder import LAYOUTS, Outcome, PlanFolder, WorkUnit
from robocas_ms3.plans.join import join_episodes
from robocas_ms3.plans.worker import Recorder
from robocas_ms3.scenes.config import load_task_config
from robocas_ms3.scenes.layout_table import FrozenLayouts
from robocas_ms3.scenes.model import SceneModel
from robocas_ms3.scenes.sample import sample_layout

ALONE = PLAN.model_copy(update={"stages": ["layouts"], "parts": PLAN.parts[:1]})


@pytest.fixture
def files(tmp_path):
    files = PlanFolder(ALONE, tmp_path).seed_files(WorkUnit(0, 0), 11)
    files.folder.mkdir(parents=True)
    return files


def test_stage_layouts_alone(files, tmp_path):
    found = Recorder(ALONE).run(files)
    assert (found["success"], set(found)) == (True, {"success", "record_seconds"})
    assert [path.name for path in files.folder.iterdir()] == [files.layout_path.name]
    report = join_episodes(PlanFolder(ALONE, tmp_path), {0: [(WorkUnit(0, 0), Outcome(11, True, size=files.size()))]})
    assert report["parts"]["a"]["seeds"] == [11]
    pack = load_pack("builtin")
    kept = FrozenLayouts(tmp_path / LAYOUTS / "a.npy", pack.objects)(11, 11)
    made = sample_layout(SceneModel.load(load_task_config("pick_table_scattered"), pack, pack), 11, 11)
    assert kept.object_ids == made.object_ids
    np.testing.assert_allclose(kept.object_poses, made.object_poses, atol=1e-6)
    assert not (tmp_path / "demos").exists()


def test_seed_without_a_layout_fails(files, monkeypatch):
    def nothing(*_):
        raise LayoutError("no room for all objects")

    monkeypatch.setattr("robocas_ms3.scenes.cache.make_layout_source", lambda *_: nothing)
    found = Recorder(ALONE).run(files)
    assert (found["success"], found["failures"]) == (False, ["layout: no room for all objects"])
