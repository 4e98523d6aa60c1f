from types import SimpleNamespace
from typing import cast

import numpy as np
import pytest
import trimesh
from asset_entries import QUALITY, object_asset

from asset_tools.grasps import sample_grasps
from asset_tools.quality import measure
from asset_tools.quality.drops import DropReport
from asset_tools.quality.measure import check_objects, compare_with_manifest, make_object_rows, measure_object
from asset_tools.resting_poses import find_resting_poses
from robocas_ms3.assets.annotations import Annotations, compute_footprints
from robocas_ms3.assets.pack import LoadedObject

REPORT = DropReport(
    ends=np.tile(np.eye(4), (3, 1, 1)),
    rest_times=np.array([0.5, 3.0, 1.0]),
    matches=np.array([0, 0, 0]),
    penetrations=np.zeros(3),
    jitters=np.array([1e-6, 0.006, 0.05]),
    rolling=np.array([False, False, True]),
    good=np.array([True, False, True]),
)


def but(**change):
    return object_asset(quality=QUALITY.model_copy(update=change))


def annotate(mesh, solid, count=60):
    rest = find_resting_poses(solid)
    grasps = sample_grasps(mesh, solid.center_of_mass, np.random.default_rng(0), count=count)
    return Annotations(
        resting_poses=rest.poses,
        resting_probabilities=rest.probabilities,
        display_pose=rest.display_pose,
        footprints=compute_footprints(list(solid.hulls), rest.poses),
        grasps_tcp_in_object=grasps.tcp_in_object,
        grasp_widths=grasps.widths,
        grasp_qualities=grasps.qualities,
        surface_points=np.zeros((1, 3)),
        surface_normals=np.array([[0.0, 0, 1]]),
    )


def test_a_block_meets_all_requirements(block):
    mesh, solid = trimesh.creation.box((0.05, 0.08, 0.12)), block(0.05, 0.08, 0.12)
    notes = annotate(mesh, solid)
    quality = measure_object(mesh, solid, notes)
    assert (quality.compact, quality.hull_count, quality.hull_vertices) == (True, 1, 8)
    assert quality.volume_iou == 1 and quality.surface_p95 == 0
    assert quality.rest_share == 1 and quality.grasps_tried == 20 and quality.grasps_held >= 0.95
    assert check_objects({"block": object_asset(quality=quality)}) == []
    assert measure_object(mesh, solid, notes) == quality


def test_an_object_without_grasps(block):
    mesh, solid = trimesh.creation.box((0.12, 0.12, 0.12)), block(0.12, 0.12, 0.12)
    quality = measure_object(mesh, solid, annotate(mesh, solid))
    assert (quality.grasps_tried, quality.grasps_held) == (0, 0)
    assert (
        check_objects(
            {"cube": object_asset(quality=quality, grasp_count=0, no_grasps_because="wide"), "b": object_asset()}
        )
        == []
    )
    found = check_objects({"cube": object_asset(quality=quality, grasp_count=0)})
    assert [(broken.asset, broken.what) for broken in found] == [
        ("cube", "number of grasps"),
        ("", "number of objects that can be grasped"),
    ]
    assert make_object_rows({"cube": quality})[0][-1] == "-"


@pytest.mark.parametrize(
    ("change", "what"),
    [
        (dict(volume_iou=0.79), "volume IoU"),
        (dict(hull_vertices=65), "vertices of a hull"),
        (dict(rest_share=0.85), "drops at rest"),
        (dict(rest_time=2.1), "median time to rest"),
        (dict(penetration=0.0021), "penetration"),
        (dict(jitter=0.051), "jitter"),
        (dict(compact=False, surface_p95=0.0041), "distance of the surfaces"),
    ],
)
def test_each_limit_of_an_object(change, what):
    pack = {"a": object_asset(), "b": object_asset(), "bad": but(**change)}
    assert [(broken.asset, broken.what) for broken in check_objects(pack)] == [("bad", what)]


def test_medians_of_the_pack():
    weak = dict(volume_iou=0.85, hull_count=9, grasps_held=0.75)
    one = {"a": object_asset(), "b": object_asset(), "c": but(**weak)}
    assert check_objects(one) == []
    most = {"a": object_asset(), "b": but(**weak), "c": but(**weak)}
    found = check_objects(most)
    assert [(broken.asset, broken.what, broken.expected, broken.found) for broken in found] == [
        ("", "median volume IoU", ">= 0.90", "0.85"),
        ("", "median hulls", "<= 8", "9"),
        ("", "median of grasps held", ">= 80%", "75%"),
    ]
    assert check_objects({}) == []


def test_the_manifest_is_compared_with_measurements():
    def loaded(grasps):
        notes = SimpleNamespace(grasp_widths=np.zeros(grasps))
        return cast(LoadedObject, SimpleNamespace(asset=object_asset(), annotations=notes))

    assert compare_with_manifest(loaded(60), QUALITY) == []
    found = compare_with_manifest(loaded(59), QUALITY.model_copy(update=dict(rest_share=0.95, grasps_held=0.85)))
    assert [(broken.what, broken.expected, broken.found) for broken in found] == [
        ("measured rest_share", "1 (manifest)", "0.95"),
        ("measured grasps_held", "0.9 (manifest)", "0.85"),
        ("measured grasp_count", "60 (manifest)", "59"),
    ]


def test_a_moving_drop_counts_as_jitter_unless_it_rolls(block):
    """Only a uniformly rolling drop may move after 2 s; a drop that is not at rest counts too."""
    mesh, solid = trimesh.creation.box((0.05, 0.08, 0.12)), block(0.05, 0.08, 0.12)
    notes = annotate(mesh, solid, count=2)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(measure, "run_drop_test", lambda *_: REPORT)
        quality = measure_object(mesh, solid, notes)
    assert (quality.rest_share, quality.rolling_share) == (0.6667, 0.3333)
    assert quality.jitter == pytest.approx(0.006 / 0.2)  # J of the second drop, kg
