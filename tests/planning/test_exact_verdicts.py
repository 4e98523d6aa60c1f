"""FCL's collision verdicts equal the stored verdicts of an exact method, linear programs.

`PYTHONPATH=. python tests/planning/exact_verdicts.py` draws the scenes and stores them with their verdicts again.
"""

from __future__ import annotations

import numpy as np
import pytest
from exact_verdicts import ExactArm, Scene, load_scenes

SCENES = load_scenes()
KINDS = {"hulls": (4, 30, 600), "arm alone": (2, 30, 400), "cloud": (3, 20, 200)}
"""Scenes of each kind, and at least how many names in contact and how many free names each of them has."""


@pytest.fixture(scope="module")
def arm(panda_files, checker) -> ExactArm:
    return ExactArm(panda_files.arm_urdf, panda_files.arm_srdf, checker)


@pytest.fixture(params=sorted(SCENES))
def scene(request: pytest.FixtureRequest) -> Scene:
    return SCENES[request.param]


def test_verdicts_of_fcl_are_the_stored_ones(panda_files, scene):
    world = scene.world(panda_files)
    for (*qpos, width), contacts, undecided in zip(scene.configurations, scene.contacts, scene.undecided, strict=True):
        found = world.contacts(np.array(qpos), width)
        assert set(found) - set(undecided) == set(contacts)
        assert world.free(np.array([qpos]), finger_width=width)[0] == (found == [])


def test_linear_programs_give_the_stored_verdicts(arm, scene):
    for i in range(0, len(scene.configurations), 5):
        assert scene.decide(arm, i) == (scene.contacts[i], scene.undecided[i])


@pytest.mark.parametrize("kind", KINDS)
def test_stored_scenes_have_contacts_and_free_names(arm, kind):
    count, least_contacts, least_free = KINDS[kind]
    scenes = [scene for name, scene in SCENES.items() if name.startswith(kind)]
    assert len(scenes) == count
    for scene in scenes:
        links = len({name for name, _ in arm.parts})
        names = links + len(scene.obstacles) + bool(scene.cubes) + bool(scene.held)
        contacts, undecided = (sum(map(len, values)) for values in (scene.contacts, scene.undecided))
        assert contacts >= least_contacts
        assert len(scene.configurations) * names - contacts - undecided >= least_free
        assert undecided <= 2
