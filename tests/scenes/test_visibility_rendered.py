"""Ray casting agrees with SAPIEN's segmentation for every object of a heap, from above and from the side."""

from __future__ import annotations

from collections.abc import Callable, Iterator

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from robocas_ms3.assets.pack import LoadedObject, load_pack
from robocas_ms3.scenes.visibility import MeshScene, PinholeCamera, load_visual_mesh, top_down_camera

pytestmark = pytest.mark.slow

SIZE, COUNT = 256, 8
Segmentation = Callable[[PinholeCamera, np.ndarray, list[int]], np.ndarray]


@pytest.fixture(scope="module")
def rendered(needs_renderer) -> Iterator[tuple[list[LoadedObject], Segmentation]]:
    """Return eight objects, and a function that renders the index of the object in each pixel (-1: none)."""
    import sapien
    from mani_skill.render import PREBUILT_SHADER_CONFIGS, set_shader_pack

    set_shader_pack(PREBUILT_SHADER_CONFIGS["minimal"])  # of the whole process; datasets are rendered with it
    pack = load_pack("builtin")
    assets = [pack.objects[i] for i in np.random.default_rng(0).choice(sorted(pack.objects), COUNT, replace=False)]
    scene = sapien.Scene()
    scene.set_ambient_light([1, 1, 1])
    actors = []
    for asset in assets:
        builder = scene.create_actor_builder()
        builder.add_visual_from_file(str(asset.visual_path("fast")))
        builder.initial_pose = sapien.Pose()
        actors.append(builder.build_kinematic())
    eye = scene.add_camera("eye", SIZE, SIZE, np.pi / 2, 0.01, 5)

    def segmentation(camera: PinholeCamera, poses: np.ndarray, shown: list[int]) -> np.ndarray:
        for i, actor in enumerate(actors):
            actor.set_pose(sapien.Pose(poses[i]) if i in shown else sapien.Pose([0, 0, -50]))
        eye.entity.set_pose(sapien.Pose(camera.pose))
        scene.update_render()
        eye.take_picture()
        numbers = eye.get_picture("PositionSegmentation")[..., 3]
        ids = np.full(numbers.shape, -1)
        for i, actor in enumerate(actors):
            ids[numbers == actor.per_scene_id] = i
        return ids

    yield assets, segmentation
    set_shader_pack(PREBUILT_SHADER_CONFIGS["default"])


def slanted_camera() -> PinholeCamera:
    """Return a camera 0.45 m from the heap, 60 degrees above it, like the gripper's camera."""
    pose = np.eye(4)
    pose[:3, :3] = Rotation.from_euler("ZYX", [40, 60, 25], degrees=True).as_matrix()
    pose[:3, 3] = [0, 0, 0.08] - 0.45 * pose[:3, 0]
    return PinholeCamera(pose, SIZE, SIZE, np.pi / 2)


@pytest.mark.parametrize(
    "camera", [top_down_camera(np.zeros(2), 0.0, size=SIZE), slanted_camera()], ids=["top", "side"]
)
@pytest.mark.parametrize("seed", [0, 1])
def test_visible_fractions_agree_with_the_segmentation(rendered, seed, camera):
    assets, segmentation = rendered
    rng = np.random.default_rng(seed)
    poses = np.tile(np.eye(4), (COUNT, 1, 1))
    poses[:, :3, :3] = Rotation.random(COUNT, random_state=rng).as_matrix()
    poses[:, :3, 3] = rng.uniform([-0.08, -0.08, 0.0], [0.08, 0.08, 0.15], (COUNT, 3))
    together = segmentation(camera, poses, list(range(COUNT)))
    visible = np.array([(together == i).sum() for i in range(COUNT)])
    full = np.array([(segmentation(camera, poses, [i]) == i).sum() for i in range(COUNT)])
    scenery = MeshScene([load_visual_mesh(asset) for asset in assets], poses)
    large = full >= 200
    shares = scenery.visible_fractions(camera)
    assert large.sum() >= 6
    assert shares[large] == pytest.approx(visible[large] / full[large], abs=0.02)
    assert shares[large].min() < 0.6  # some objects are hidden
    assert (scenery.render_segmentation(camera)[0] != together).mean() < 0.0005  # the same pixels, edges aside
