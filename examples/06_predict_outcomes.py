"""Predict from geometry which grasps succeed and which pushes help, and test the predictions in held-out scenes.

python examples/06_predict_outcomes.py CANDIDATES.h5 ...

The features are computed from the poses and shapes of the objects before the candidate, and from its planned motion.
"""

import sys
from dataclasses import dataclass, field

import numpy as np
import torch
from torch import nn

from robocas_ms3.assets.pack import Pack, load_pack
from robocas_ms3.demos import CandidateFile
from robocas_ms3.demos.candidates.labels import MIN_BENEFIT
from robocas_ms3.planning.clearing_cost import compute_clearing_cost

FOLDS, MODELS, STEPS = 5, 5, 300  # each fifth of the scenes is held out once; models per fold, training steps
POINTS = 400  # per object
CELL, CELLS, NOTHING = 0.01, 40, -1.0  # m, edge of the cells of a height map; cells per side; height of an empty cell
FINGER, PALM = 0.04, 0.10  # m from the TCP: inner side of an open finger, and the palm
# boxes in the TCP frame (x across the fingers, y closing direction, z approach), lower and upper corner, m
BOXES = {
    "between the fingers": ((-0.011, -FINGER, -0.02), (0.011, FINGER, 0.009)),
    "left finger": ((-0.011, FINGER, -PALM), (0.011, FINGER + 0.02, 0.009)),
    "right finger": ((-0.011, -FINGER - 0.02, -PALM), (0.011, -FINGER, 0.009)),
    "palm": ((-0.03, -0.10, -PALM - 0.08), (0.03, 0.10, -PALM)),
}


def to_matrix(pose: np.ndarray) -> np.ndarray:
    """Return the 4x4 matrix of a pose (7,): position, unit quaternion wxyz."""
    w, x, y, z = pose[3:]
    matrix = np.eye(4)
    matrix[:3, 3] = pose[:3]
    matrix[:3, :3] = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ]
    return matrix


def transform(matrix: np.ndarray, points: np.ndarray) -> np.ndarray:
    return points @ matrix[:3, :3].T + matrix[:3, 3]


class Scene:
    """Objects before a decision: their surface points (P, 3) in the arm's base frame by slot."""

    def __init__(self, values: dict, pack: Pack) -> None:
        self.values = values
        self.points = {}
        for slot in np.flatnonzero(values["present"]).tolist():
            points = pack.objects[values["object_id"][slot]].surface_points()
            points = points[:: max(1, len(points) // POINTS)]
            self.points[slot] = transform(to_matrix(values["object_in_base"][slot]), points)

    def others(self, *slots: int) -> np.ndarray:
        return np.concatenate(
            [np.empty((0, 3)), *(points for slot, points in self.points.items() if slot not in slots)]
        )

    def clutter(self, slot: int) -> list[float]:
        return [float(self.values[name][slot]) for name in ("hidden_fraction", "obstacles", "free_grasps")]


def grasp_features(scene: Scene, slot: int, start: np.ndarray) -> list[float]:
    """Describe a grasp: which points are between and at the fingers, its pose, and the clutter around the object."""
    tcp, own = to_matrix(start), scene.points[slot]
    features = []
    in_tcp = [transform(np.linalg.inv(tcp), points) for points in (own, scene.others(slot))]
    for low, high in BOXES.values():
        for points in in_tcp:
            inside = ((points >= low) & (points <= high)).all(axis=1)
            features += [np.log1p(inside.sum())]
    low, high = BOXES["between the fingers"]
    gripped = in_tcp[0][((in_tcp[0] >= low) & (in_tcp[0] <= high))[:, [0, 2]].all(axis=1)]
    gripped = gripped if len(gripped) else np.full((1, 3), 0.2)  # nothing between the fingers
    features += [*gripped.min(axis=0), *gripped.max(axis=0), *in_tcp[0].min(axis=0), *in_tcp[0].max(axis=0)]
    middle = own.mean(axis=0)
    features += [*(tcp[:3, 3] - middle), *np.ptp(own, axis=0), *tcp[:3, 2], abs(tcp[2, 1]), tcp[2, 3]]
    features += [np.linalg.norm(tcp[:2, 3]), np.arctan2(tcp[1, 3], tcp[0, 3]), own[:, 2].min(), own[:, 2].max()]
    distance = np.linalg.norm(scene.others(slot) - tcp[:3, 3], axis=1)
    features += [distance.min(initial=0.3), np.log1p((distance < 0.06).sum())]
    return [*features, *scene.clutter(slot)]


def push_features(scene: Scene, slot: int, target: int, start: np.ndarray, end: np.ndarray) -> list[float]:
    """Describe a push: its path relative to object and target, and the clutter if only the pushed object moved."""
    own, goal, others = scene.points[slot], scene.points[target], scene.others(slot, target)
    push = end[:2] - start[:2]
    length = float(np.linalg.norm(push))
    ahead = push / max(length, 1e-6)
    aside = np.array([-ahead[1], ahead[0]])
    features = [length, start[2], start[0], start[1], float(slot == target)]
    for points in (own, goal):
        along, across = (points[:, :2] - start[:2]) @ ahead, (points[:, :2] - start[:2]) @ aside
        features += [along.min(), along.max(), across.min(), across.max(), points[:, 2].min(), points[:, 2].max()]
    shift = max(0.0, length - max(0.0, float(((own[:, :2] - start[:2]) @ ahead).min())))
    moved = own + [*(shift * ahead), 0.0]
    offset, after = own.mean(axis=0) - goal.mean(axis=0), moved.mean(axis=0) - goal.mean(axis=0)
    features += [shift, offset[2], np.linalg.norm(offset[:2]), np.linalg.norm(after[:2])]
    features += [float(ahead @ offset[:2]) / max(float(np.linalg.norm(offset[:2])), 1e-3)]
    # the clutter now, without the object, and after the push
    middle, hidden, is_obstacle = goal.mean(axis=0), [], []
    maps = [height_map(points, middle) for points in (goal, others, own, moved)]
    for pushed in (maps[2], None, maps[3]):
        top = maps[1] if pushed is None else np.maximum(maps[1], pushed)
        seen = maps[0] > NOTHING
        hidden.append(float((seen & (top > maps[0])).sum() / max(1, seen.sum())))
        high = np.full_like(top, NOTHING) if pushed is None else pushed
        is_obstacle.append(float((dilate(seen) & (high > np.maximum(maps[0], middle[2]))).any()))
    around = scene.clutter(target)[1]
    costs = [
        compute_clearing_cost(around - is_obstacle[0] + one, part, 1)
        for one, part in zip(is_obstacle, hidden, strict=True)
    ]
    features += [*hidden, *is_obstacle, *costs, costs[0] - costs[1], costs[0] - costs[2]]
    along, across = (others[:, :2] - start[:2]) @ ahead, (others[:, :2] - start[:2]) @ aside
    swept = (abs(across) < 0.03) & (along > 0) & (along < length + 0.05) & (others[:, 2] > start[2] - 0.02)
    features += [np.log1p(swept.sum())]
    return [*features, *scene.clutter(target), *scene.clutter(slot)]


def height_map(points: np.ndarray, middle: np.ndarray) -> np.ndarray:
    """Return the greatest height of the points in each cell of a grid around ``middle``, seen from above."""
    heights = np.full((CELLS, CELLS), NOTHING)
    cells = np.floor((points[:, :2] - middle[:2]) / CELL).astype(int) + CELLS // 2
    inside = ((cells >= 0) & (cells < CELLS)).all(axis=1)
    np.maximum.at(heights, tuple(cells[inside].T), points[inside, 2])
    return heights


def dilate(mask: np.ndarray) -> np.ndarray:
    """Return a mask with the cells next to the cells of a mask."""
    padded = np.pad(mask, 1)
    shifts = [padded[1 + x : CELLS + 1 + x, 1 + y : CELLS + 1 + y] for x in (-1, 0, 1) for y in (-1, 0, 1)]
    return np.any(shifts, axis=0)


@dataclass
class Samples:
    """Samples of a primitive: scene, features and label of each one, and whether its target is that of the episode."""

    scenes: list[str] = field(default_factory=list)
    features: list[list[float]] = field(default_factory=list)
    labels: list[bool] = field(default_factory=list)
    instructed: list[bool] = field(default_factory=list)
    sources: list[str] = field(default_factory=list)


def read_samples(paths: list[str], primitive: str) -> Samples:
    """Read the grasps, labelled by their success, or the pushes, labelled by whether they helped a target.

    A push is a sample for each target that it could help: one simulation serves several instructions. Candidates whose
    start is unknown are left out.
    """
    samples = Samples()
    for path in paths:
        file = CandidateFile(path)
        pack, labels = load_pack(file.recorded_env.kwargs.get("pack", "builtin")), file.labels
        for row in range(len(file)):
            decision, first = file.decision(row), file.rows_of(row).start
            found, scene = decision.candidates, Scene(decision.values, pack)
            known = ~np.isnan(found["start_in_base"][:, 0]) & (found["primitive"] == primitive)
            for number in np.flatnonzero(known).tolist():
                slot, start, end = (found[name][number] for name in ("slot", "start_in_base", "end_in_base"))
                target, added = int(decision.values["target_slot"]), []
                if primitive == "grasp":
                    added = [(target, grasp_features(scene, int(slot), start), found["success"][number])]
                else:
                    for other in np.flatnonzero(labels.cost_before[first + number] >= MIN_BENEFIT).tolist():
                        features = push_features(scene, int(slot), other, start, end)
                        added.append((other, features, labels.helped[first + number, other]))
                for other, features, label in added:
                    samples.scenes.append(f"{file.recorded_env.env_id} {decision.values['seed']}")
                    samples.features.append(features)
                    samples.labels.append(bool(label))
                    samples.instructed.append(other == target)
                    samples.sources.append(str(found["source"][number]))
    return samples


def predict(train: np.ndarray, labels: np.ndarray, scenes: np.ndarray, test: np.ndarray) -> np.ndarray:
    """Train small networks on features (N, F) and labels (N,); return the mean score (M,) of test samples (M, F).

    Each network stops at its lowest loss in a fifth of the training scenes (N,), which it does not train on.
    """
    mean, std = train.mean(axis=0), train.std(axis=0) + 1e-6
    inputs, test_inputs = (torch.tensor(np.clip((x - mean) / std, -5, 5), dtype=torch.float32) for x in (train, test))
    targets, scores = torch.tensor(labels, dtype=torch.float32), []
    compute_loss = nn.functional.binary_cross_entropy_with_logits
    for seed in range(MODELS):
        torch.manual_seed(seed)
        names = np.random.default_rng(seed).permutation(np.unique(scenes))
        kept = torch.tensor(np.isin(scenes, names[: max(1, len(names) // 5)]))
        rows = torch.nonzero(~kept)[:, 0]
        sizes = ((inputs.shape[1], 32), (32, 32))
        layers = [layer for size in sizes for layer in (nn.Linear(*size), nn.ReLU(), nn.Dropout(0.3))]
        model = nn.Sequential(*layers, nn.Linear(32, 1))
        optimizer = torch.optim.AdamW(model.parameters(), lr=2e-3, weight_decay=0.3)
        lowest, best = np.inf, np.zeros(len(test))
        for step in range(STEPS):
            model.train()
            batch = rows[torch.randperm(len(rows))[:512]]
            loss = compute_loss(model(inputs[batch])[:, 0], targets[batch])
            optimizer.zero_grad()
            loss.backward()
            optimizer.step()
            if step % 10 == 9:
                model.eval()
                with torch.no_grad():
                    found = float(compute_loss(model(inputs[kept])[:, 0], targets[kept]))
                    if found < lowest:
                        lowest, best = found, model(test_inputs)[:, 0].sigmoid().numpy()
        scores.append(best)
    return np.mean(scores, axis=0)


def compute_auc(labels: np.ndarray, scores: np.ndarray) -> float:
    """Return the area under the ROC curve: the probability that a positive sample has a higher score."""
    positive, negative = scores[labels], np.sort(scores[~labels])
    if not len(positive) or not len(negative):
        return np.nan
    below, up_to = (np.searchsorted(negative, positive, side=side) for side in ("left", "right"))
    return float((below + up_to).mean() / 2 / len(negative))


def describe_auc(scenes: np.ndarray, labels: np.ndarray, scores: np.ndarray) -> str:
    """Return the AUC with its 95 % bootstrap interval; scenes are drawn, since their candidates are not independent."""
    names, index = np.unique(scenes, return_inverse=True)
    rng, rows = np.random.default_rng(0), [np.flatnonzero(index == number) for number in range(len(names))]
    drawn = [np.concatenate([rows[n] for n in rng.integers(len(rows), size=len(rows))]) for _ in range(500)]
    low, high = np.nanpercentile([compute_auc(labels[draw], scores[draw]) for draw in drawn], [2.5, 97.5])
    about = f"{len(labels)} candidates, {len(names)} scenes, {labels.mean():.0%} positive"
    return f"AUC {compute_auc(labels, scores):.3f} [{low:.3f}, {high:.3f}] ({about})"


def main(paths: list[str]) -> None:
    torch.set_num_threads(1)  # faster for small networks
    for primitive, label in (("grasp", "success"), ("push", "helped")):
        samples = read_samples(paths, primitive)
        scenes, labels = np.array(samples.scenes), np.array(samples.labels)
        if len(set(samples.scenes)) < FOLDS or len(set(samples.labels)) < 2:
            print(f"{primitive}: not evaluated; expected {FOLDS} scenes or more, with successes and failures")
            continue
        features, sources = np.array(samples.features), np.array(samples.sources)
        names, index = np.unique(scenes, return_inverse=True)
        fold = np.random.default_rng(0).permutation(len(names))[index] % FOLDS
        scores = np.zeros(len(labels))
        for held_out in range(FOLDS):
            test = fold == held_out
            scores[test] = predict(features[~test], labels[~test], scenes[~test], features[test])
        tested = np.array(samples.instructed)  # other targets are only used for training
        by_source = {"expert": tested & (sources == "expert"), "other": tested & (sources != "expert")}
        for name, rows in {"all": tested, **by_source}.items():
            if len(set(labels[rows])) == 2 and len(set(scenes[rows])) >= FOLDS:
                print(
                    f"{primitive} {label}, {name} candidates: {describe_auc(scenes[rows], labels[rows], scores[rows])}"
                )


if __name__ == "__main__":
    if len(sys.argv) < 2:
        sys.exit("usage: python examples/06_predict_outcomes.py CANDIDATES.h5 ...")
    main(sys.argv[1:])
