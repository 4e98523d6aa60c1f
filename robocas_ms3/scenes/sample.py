"""Sample a layout from seeds: the objects, their poses, the target."""

from __future__ import annotations

import logging
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from robocas_ms3.assets.pack import LoadedFurniture, LoadedObject
from robocas_ms3.core.errors import LayoutError
from robocas_ms3.core.poses import from_xyz_yaw, transform_points
from robocas_ms3.scenes.config.task import OrderlyLayout, ScatteredLayout, StackedLayout
from robocas_ms3.scenes.heap import drop_heap
from robocas_ms3.scenes.layout import PARKING_HEIGHT, Layout, ObjectIds
from robocas_ms3.scenes.lookup import resolve_ids
from robocas_ms3.scenes.model import SceneModel
from robocas_ms3.scenes.placement import Array, PlaceableObject, draw_object_ids, sample_orderly, sample_scattered
from robocas_ms3.scenes.robot_placement import place_basket, place_robot
from robocas_ms3.scenes.settle import settle
from robocas_ms3.scenes.targets import SettledScene, choose_target, find_target_rule
from robocas_ms3.scenes.task_specs import TASKS

# Each random decision of a scene has its own stream, so that a new decision does not change the others.
_OBJECTS, _LAYOUT, _TARGET, _ROBOT, _BASKET, _COUNT = range(6)
_SETS, _TRIES = 5, 10  # sets of objects per seed, and layouts per set
_KINDS = 50  # tries to find kinds whose columns fit
_SEVERAL = 5  # number of layouts without a target from which the error reports the target as the reason
_log = logging.getLogger(__name__)


def draw_object_set(model: SceneModel, objects_seed: int, number: int = 0) -> ObjectIds:
    """Draw a set of objects: one id per slot, the distractors last.

    Args:
        model: configuration and assets.
        objects_seed: seed of the objects.
        number: 0 for the first set of this seed, 1 for the second set, ...

    Raises:
        LayoutError: no object or no column of objects fits on the surface.
    """
    config = model.config
    rng = np.random.default_rng([objects_seed, _OBJECTS, number])
    ids = list(model.object_ids)
    if config.randomisation.object_sets:
        wanted = config.randomisation.object_sets[rng.integers(len(config.randomisation.object_sets))]
        ids = resolve_ids(model.object_pack, wanted, key="randomisation.object_sets")
    if isinstance(config.layout, OrderlyLayout):
        chosen = _draw_kinds_that_fit(rng, model, _find_usable_ids(model, ids, columns=True), config.layout.copies)
    else:
        chosen = draw_object_ids(
            rng, _find_usable_ids(model, ids), config.objects.count, repeats=config.objects.repeats
        )
    distractors = config.randomisation.distractors
    if distractors is not None:
        others = _find_usable_ids(
            model, resolve_ids(model.object_pack, distractors.ids, key="randomisation.distractors.ids")
        )
        chosen += draw_object_ids(rng, [i for i in others if i not in chosen] or others, distractors.count[1])
    return tuple(chosen)


def sample_layout(model: SceneModel, objects_seed: int, seed: int, object_ids: ObjectIds | None = None) -> Layout:
    """Draw a layout, let the objects settle, and choose the target. Equal seeds give equal layouts.

    Several sets of objects are drawn (`draw_object_set`), because some sets have no valid layout. The first set with a
    valid layout is used.

    Args:
        model: configuration and assets.
        objects_seed: decides the objects. For a single env it equals ``seed``.
        seed: decides everything else.
        object_ids: objects of ``objects_seed``. None: if the seeds differ, the layout with both seeds equal to
            ``objects_seed`` is sampled first, and its objects are used.

    Raises:
        LayoutError: the objects don't fit, don't come to rest, or no object qualifies as the target; or there is no
            valid pose of robot or basket.
    """

    def make_rng(stream: int) -> np.random.Generator:
        return np.random.default_rng([seed, stream])

    if object_ids is None and objects_seed != seed:
        object_ids = sample_layout(model, objects_seed, objects_seed).object_ids
    config = model.config
    basket_rng = make_rng(_BASKET)
    robot_pose = place_robot(model, make_rng(_ROBOT))
    basket_pose = place_basket(model, robot_pose, basket_rng)
    layout_rng, target_rng = make_rng(_LAYOUT), make_rng(_TARGET)
    unsettled, untargeted, unarranged = 0, 0, []
    for number in range(_SETS):
        try:
            ids = object_ids or draw_object_set(model, objects_seed, number)
        except LayoutError as error:
            unarranged += [error] * _TRIES
            continue
        assets = [model.object_pack.objects[i] for i in ids]
        wanted, candidate = _draw_used_slots(model, len(ids), make_rng(_COUNT))
        for _ in range(_TRIES):
            poses = np.stack([_parking_pose(slot, asset) for slot, asset in enumerate(assets)])
            try:
                arranged, fits = _draw_poses(layout_rng, model, [assets[slot] for slot in np.flatnonzero(wanted)])
            except LayoutError as error:
                if isinstance(config.layout, OrderlyLayout):
                    unarranged.append(error)  # in another order the columns may fit
                    continue
                if object_ids is not None:
                    raise  # the function has already tried many times
                unarranged += [error] * _TRIES
                break
            present = wanted.copy()
            present[wanted] = fits
            used = [assets[slot] for slot in np.flatnonzero(present)]
            placed = model.support_pose @ model.support_motion(opened=False) @ arranged[fits]
            if config.randomisation.basket is not None and overlaps_basket(used, placed, model.basket, basket_pose):
                basket_pose = place_basket(model, robot_pose, basket_rng)
                unsettled += 1
                continue
            heap = isinstance(config.layout, StackedLayout)
            poses[present], stable = settle(used, placed, model, basket_pose, heap=heap)
            if not stable:
                unsettled += 1
                continue
            scene = SettledScene(model, assets, poses, present, candidate & present, robot_pose, basket_pose)
            if (choice := choose_target(target_rng, scene)) is not None:
                return Layout(
                    ids, poses, robot_pose, basket_pose, choice.slot, choice.relation, present, choice.visible_fractions
                )
            untargeted += 1
    raise _make_layout_error(model, unarranged, unsettled, untargeted)


def overlaps_basket(
    assets: list[LoadedObject], poses: Array, basket: LoadedFurniture | None, basket_pose: Array | None
) -> bool:
    """Return whether the bounding box of any object overlaps the bounding box of the basket.

    Bounding boxes are aligned with the axes of the basket.

    Args:
        assets: K objects.
        poses: (K, 4, 4) poses of the objects in the world.
        basket: the basket; None: no overlap.
        basket_pose: (4, 4) pose of the basket in the world.
    """
    if basket is None or basket_pose is None:
        return False
    walls = np.concatenate(basket.hulls)
    low, high = walls.min(axis=0), walls.max(axis=0)
    for asset, pose in zip(assets, poses, strict=True):
        points = transform_points(np.linalg.inv(basket_pose) @ pose, np.concatenate(asset.hulls))
        if np.all((points.max(axis=0) > low) & (points.min(axis=0) < high)):
            return True
    return False


def _make_layout_error(
    model: SceneModel, unarranged: list[LayoutError], unsettled: int, untargeted: int
) -> LayoutError:
    """Return the error for seeds without a layout. It names the most likely reason."""
    if untargeted < _SEVERAL and len(unarranged) > _SETS * _TRIES // 2:
        return unarranged[-1]
    found = (
        f"{_SETS * _TRIES} layouts tried: {len(unarranged)} did not fit, {unsettled} did not come to rest or touched "
        f"the basket, {untargeted} had no target"
    )
    if untargeted < _SEVERAL:
        fix = (
            "Lower objects.count, enlarge the surface, use more stable objects, or lower randomisation.basket.position."
        )
        return LayoutError("the objects don't come to rest", where="layout", found=found, fix=fix)
    lower = ", ".join(find_target_rule(model.config.task).keys)
    fix = f"Raise target.max_distance, lower target.{lower} or min_free_grasps, or use other objects."
    relations = ", ".join(model.config.target.relations)
    if relations and "relation" in TASKS[model.config.task].slots:
        fix = f"Use target.relations other than {relations}, or raise layout.copies. {fix}"
    return LayoutError("no object qualifies as the target", where="target", found=found, fix=fix)


def _draw_kinds_that_fit(rng: np.random.Generator, model: SceneModel, ids: list[str], copies: int) -> list[str]:
    objects, count = model.object_pack.objects, model.config.objects.count
    failure = LayoutError("no kinds fit", where="objects.ids")
    for attempt in range(_KINDS):
        kinds = draw_object_ids(rng, ids, -(-count // copies), repeats=model.config.objects.repeats)
        chosen = [kind for kind in kinds for _ in range(copies)][:count]
        try:
            _draw_poses(np.random.default_rng(attempt), model, [objects[i] for i in chosen])
            return chosen
        except LayoutError as error:
            failure = error
    raise failure


def _find_usable_ids(model: SceneModel, ids: list[str], *, columns: bool = False) -> list[str]:
    """Return the ids of the objects that are low enough for the surface.

    With ``columns``, return only ids of objects with a display pose.

    If no object has a display pose, ``columns`` has no effect.
    """
    if not columns and model.headroom == np.inf:
        return ids
    things = {i: make_placeable(model.object_pack.objects[i], model.headroom) for i in ids}
    usable = [i for i in ids if len(things[i].resting_poses)]
    if not usable:
        what, room = "all objects are too high for the surface", f"an object lower than {model.headroom:.3f} m"
        fix = "Add lower objects to objects.ids, or choose another surface."
        raise LayoutError(what, where="objects.ids", expected=room, fix=fix)
    if columns:
        usable = [i for i in usable if things[i].display_pose >= 0] or usable
    if model.config.objects.ids != "all" and len(usable) < len(ids):
        _warn_excluded(tuple(i for i in ids if i not in usable))
    return usable


@lru_cache  # once each
def _warn_excluded(ids: tuple[str, ...]) -> None:
    _log.warning(
        "objects excluded, because they are too high for the surface or, in an orderly layout, have no display pose: "
        "%s",
        ", ".join(ids),
    )


def make_placeable(asset: LoadedObject, headroom: float = np.inf) -> PlaceableObject:
    """Return an object with only those resting poses in which it is lower than ``headroom``, m."""
    notes = asset.annotations
    low = np.arange(len(notes.resting_poses))
    if np.isfinite(headroom):
        points = np.concatenate(asset.hulls)
        low = low[[transform_points(pose, points)[:, 2].max() < headroom for pose in notes.resting_poses]]
    return PlaceableObject(
        asset.asset.id,
        notes.resting_poses[low],
        notes.resting_probabilities[low],
        [notes.footprint(i) for i in low.tolist()],
        int(np.flatnonzero(low == notes.display_pose)[0]) if notes.display_pose in low else -1,
    )


def _draw_poses(
    rng: np.random.Generator, model: SceneModel, assets: list[LoadedObject]
) -> tuple[Array, NDArray[np.bool_]]:
    """Draw poses (K, 4, 4) of objects in the furniture's frame, and (K,) whether each fits."""
    layout, region, everything = model.config.layout, model.region, np.ones(len(assets), dtype=bool)
    if isinstance(layout, StackedLayout):
        return drop_heap(rng, assets, region, layout, headroom=model.headroom), everything
    placeables = [make_placeable(asset, model.headroom) for asset in assets]
    if isinstance(layout, ScatteredLayout):
        return sample_scattered(rng, placeables, region, layout), everything
    return sample_orderly(rng, placeables, region, layout, model.front_direction)


def _draw_used_slots(model: SceneModel, slots: int, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """Draw which slots are used (K,), and which of them may be the target (K,): all except distractors."""
    config = model.config
    count, random = config.objects.count, config.randomisation
    used = int(rng.integers(random.count[0], random.count[1] + 1)) if random.count else count
    extra = int(rng.integers(random.distractors.count[0], random.distractors.count[1] + 1)) if random.distractors else 0
    slot = np.arange(slots)
    candidate = slot < used
    return candidate | ((slot >= count) & (slot < count + extra)), candidate


def _parking_pose(slot: int, asset: LoadedObject) -> Array:
    return from_xyz_yaw(slot * 0.5, 0, PARKING_HEIGHT, 0) @ asset.annotations.resting_poses[0]
