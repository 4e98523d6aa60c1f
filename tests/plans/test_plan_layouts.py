"""The stage of layouts keeps the scenes that environments have."""

import numpy as np
import pytest
from plan_stages import PLAN

from robocas_ms3.assets.pack import load_pack
from robocas_ms3.core.errors import LayoutError
from robocas_ms3.plans.join import LAYOUTS, join
from robocas_ms3.plans.layouts import LayoutMaker
from robocas_ms3.plans.record import Records
from robocas_ms3.plans.units import Outcome, Task, Unit
from robocas_ms3.scenes.config import load_task_config
from robocas_ms3.scenes.frozen import FrozenLayouts
from robocas_ms3.scenes.model import SceneModel
from robocas_ms3.scenes.sample import sample_layout

ALONE = PLAN.model_copy(update={"stages": ["layouts"], "parts": PLAN.parts[:1]})


@pytest.fixture
def task(tmp_path):
    unit = Unit(0, 0)
    unit.folder(ALONE, tmp_path).mkdir(parents=True)
    return Task(0, 11, unit.folder(ALONE, tmp_path))


def test_layouts_alone_are_made_and_joined(task, tmp_path):
    found = Records(ALONE).run(task)
    assert (found["success"], set(found)) == (True, {"success", "record_seconds"})
    assert [path.name for path in task.folder.iterdir()] == [task.layout.name]
    outcome = Outcome(11, True, size=task.size())
    report = join(ALONE, tmp_path, {0: [(Unit(0, 0), outcome)]}, jobs=1, say=lambda text: None)
    assert report["parts"]["a"]["seeds"] == [11]
    pack = load_pack("builtin")
    kept = FrozenLayouts(tmp_path / LAYOUTS / "a.npy", pack.objects)(11, 11)
    made = sample_layout(SceneModel.load(load_task_config("pick_table_scattered"), pack, pack), 11, 11)
    assert kept.object_ids == made.object_ids
    np.testing.assert_allclose(kept.object_poses, made.object_poses, atol=1e-6)
    assert not (tmp_path / "demos").exists()


def test_a_seed_without_a_layout_is_one_that_failed(task, monkeypatch):
    def nothing(self, task):
        raise LayoutError("no room for all objects")

    monkeypatch.setattr(LayoutMaker, "write", nothing)
    found = Records(ALONE).run(task)
    assert (found["success"], found["failures"]) == (False, ["layout: no room for all objects"])
