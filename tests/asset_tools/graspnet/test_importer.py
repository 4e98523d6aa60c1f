import re

import numpy as np
import pytest
import trimesh

from asset_tools.graspnet.importer import load_graspnet_source, make_graspnet_jobs
from asset_tools.graspnet.labels import make_view_directions
from asset_tools.grasps import sample_grasps
from robocas_ms3.core.errors import AssetError

BOX = (0.04, 0.10, 0.06)


def write_models(root, numbers):
    for number in numbers:
        folder = root / "models" / f"{number:03d}"
        folder.mkdir(parents=True)
        trimesh.creation.box(BOX).export(folder / "textured.obj")
    return root


def write_labels(path, poses, depth=0.02):
    """Label some grasps, turned onto the lattice; returns their TCP poses."""
    views = make_view_directions()
    chosen = np.argmax(-poses[:, :3, 2] @ views.T, axis=1)
    approach = -views[chosen]
    level = np.column_stack([-approach[:, 1], approach[:, 0], 0 * approach[:, 0]])
    level /= np.linalg.norm(level, axis=1, keepdims=True)
    closing = poses[:, :3, 1] - np.einsum("ni,ni->n", poses[:, :3, 1], approach)[:, None] * approach
    closing /= np.linalg.norm(closing, axis=1, keepdims=True)
    across = np.einsum("ni,ni->n", closing, np.cross(approach, level))
    angles = np.arctan2(across, np.einsum("ni,ni->n", closing, level))
    count = len(poses)
    each = np.arange(count)
    offsets = np.zeros((count, 300, 12, 4, 3), np.float32)
    scores = np.full((count, 300, 12, 4), -1, np.float32)
    offsets[each, chosen, 0, 1] = np.column_stack([angles, np.full(count, depth), np.full(count, 0.06)])
    scores[each, chosen, 0, 1] = 0.2
    path.parent.mkdir(exist_ok=True)
    collision = np.zeros(scores.shape, bool)
    np.savez_compressed(
        path, points=poses[:, :3, 3] - depth * approach, offsets=offsets, scores=scores, collision=collision
    )
    expected = np.tile(np.eye(4), (count, 1, 1))
    expected[:, :3, :3] = np.stack([np.cross(closing, approach), closing, approach], axis=2)
    expected[:, :3, 3] = poses[:, :3, 3]
    return expected


def test_a_model_without_labels(tmp_path):
    source = load_graspnet_source(write_models(tmp_path, [2]), 2)
    assert (source.id, source.name, source.category) == ("tomato_soup_can", "tomato soup can", "can")
    assert source.graspnet_id == 2
    assert source.mass == 0.349
    assert source.mesh.extents == pytest.approx(BOX)
    assert source.grasps is None
    assert "GraspNet" in source.attribution


def test_missing_models_are_named_before_the_import(tmp_path):
    write_models(tmp_path, [1, 3])
    with pytest.raises(AssetError, match="numbers 2, 4"):
        make_graspnet_jobs(tmp_path, [4, 1, 2])
    with pytest.raises(AssetError, match="found 88, 90"):
        make_graspnet_jobs(tmp_path, [1, 88, 90])
    with pytest.raises(AssetError, match="46 objects"):
        make_graspnet_jobs(tmp_path)
    assert [job.id for job in make_graspnet_jobs(tmp_path, [3, 1])] == ["sugar_box", "mustard_bottle"]


def test_jobs_follow_their_files(tmp_path):
    write_models(tmp_path, [1])
    first = make_graspnet_jobs(tmp_path, [1])[0].content
    assert make_graspnet_jobs(tmp_path, [1])[0].content == first
    write_labels(tmp_path / "grasp_label" / "001_labels.npz", np.eye(4)[None])
    assert make_graspnet_jobs(tmp_path, [1])[0].content != first


@pytest.fixture(scope="module")
def labelled_banana(shared_dir, tmp_path_factory):
    """The real model with labels made of sampled grasps: the source, and the poses that were labelled."""
    root = tmp_path_factory.mktemp("graspnet")
    (root / "models").symlink_to(shared_dir / "graspnet_sample" / "models")
    plain = load_graspnet_source(root, 5)
    grasps = sample_grasps(plain.closed, plain.closed.center_mass, np.random.default_rng(0), count=30)
    poses = write_labels(root / "grasp_label" / "005_labels.npz", grasps.tcp_in_object)
    return load_graspnet_source(root, 5), poses


def test_a_banana_with_labels(labelled_banana):
    source, labelled = labelled_banana
    assert source.id == "banana"
    notes = "; ".join(source.repairs)
    assert source.grasps is not None
    assert source.closed.is_watertight
    assert source.mesh.visual.material.image is not None
    assert source.closed.bounds == pytest.approx(source.mesh.bounds, abs=1e-3)
    assert source.mesh.extents == pytest.approx([0.196, 0.079, 0.038], abs=1e-3)  # a banana on its side
    fit, more = map(int, re.findall(r"(\d+) of 30 good grasp labels fit the gripper; sampled (\d+) more", notes)[0])
    assert 10 <= fit <= 30 and len(source.grasps) == fit + more >= 50
    for pose in source.grasps.tcp_in_object[:fit]:
        assert np.abs(labelled - pose).max(axis=(1, 2)).min() < 1e-5
    assert source.grasps.qualities[:fit] == pytest.approx(np.full(fit, 0.2), abs=1e-6)


def test_enough_labels_need_no_sampled_grasps(tmp_path):
    write_models(tmp_path, [1])
    plain = load_graspnet_source(tmp_path, 1)
    grasps = sample_grasps(plain.closed, plain.closed.center_mass, np.random.default_rng(0), count=90)
    write_labels(tmp_path / "grasp_label" / "001_labels.npz", grasps.tcp_in_object)
    source = load_graspnet_source(tmp_path, 1)
    assert source.grasps is not None
    assert 50 <= len(source.grasps) <= 90
    assert not any("label" in note for note in source.repairs)
    assert source.grasps.qualities == pytest.approx(np.full(len(source.grasps), 0.2), abs=1e-6)
