"""Check a dataset with LeRobot; run by check_lerobot.sh in LeRobot's own environment.

python check_lerobot.py DATASET [ROBOCAS_DATASET]
"""

import json
import subprocess
import sys
import tempfile
import threading
import time
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from importlib.metadata import version
from pathlib import Path
from shutil import copytree

import numpy as np
import pandas as pd
import torch
from lerobot.datasets.lerobot_dataset import LeRobotDataset
from PIL import Image

TRAIN_STEPS = 10
PRECISION_MM = 0  # of depth values up to MAX_DEPTH_MM
MAX_DEPTH_MM = 4095  # greater depths are stored as this value
SPEECH = "On my way."
ANSWERS = {"speech": SPEECH, "text": SPEECH}
"""Answer of the stub server to every prompt."""


def main(root: Path, source: Path | None) -> None:
    """Run all checks; a failed check raises an error."""
    versions = {name: version(name) for name in ("lerobot", "torch", "torchvision", "datasets", "av", "pyarrow")}
    say(f"versions: {versions}")
    start = time.perf_counter()
    dataset = load(root)
    say(f"loaded in {time.perf_counter() - start:.1f} s: {dataset.num_episodes} episodes, {len(dataset)} frames")
    say(f"format {dataset.meta.info['codebase_version']}, {dataset.fps} fps, cameras {dataset.meta.camera_keys}")
    check_items(dataset)
    check_iteration(dataset)
    if "language_persistent" in dataset.meta.features:
        check_subgoals(dataset, root, source)
        check_depth(dataset, root, source)
        check_annotations(dataset, root)
        check_train(dataset, root)
    say(f"LeRobot {versions['lerobot']} accepts {root}")


def load(root: Path) -> LeRobotDataset:
    """Open a dataset with the video backend that needs no FFmpeg on the machine."""
    return LeRobotDataset(f"robocas/{root.name}", root=root, video_backend="pyav")


def check_items(dataset: LeRobotDataset) -> None:
    """Read the first, middle and last frame of each episode; compare texts and statistics with the tables."""
    starts, subgoals = np.cumsum([0, *lengths(dataset)]), subtask_texts(dataset)
    for episode, (first, end) in enumerate(zip(starts, starts[1:], strict=False)):
        for number in (first, (first + end) // 2, end - 1):
            item = dataset[int(number)]
            assert item["index"] == number
            assert item["episode_index"] == episode
            assert item["task"] == instruction(dataset, episode)
            if "next.done" in item:
                assert bool(item["next.done"]) == (number == end - 1)
                assert float(item["next.reward"]) == float(item["next.success"])
            if subgoals:
                assert item["subtask"] == subgoals[int(item["subtask_index"])]
    for key, value in item.items():
        shown = f"{tuple(value.shape)} {value.dtype}" if isinstance(value, torch.Tensor) else repr(value)[:100]
        say(f"  {key}: {shown}")
    for key, stats in dataset.meta.stats.items():
        assert {"min", "max", "mean", "std", "count"} <= set(stats), key
    say(f"indexed {3 * (len(starts) - 1)} frames; statistics of {len(dataset.meta.stats)} features")


def lengths(dataset: LeRobotDataset) -> list[int]:
    """Return the number of frames of each episode; format v2.1 has a dictionary of episodes, v3.0 a table."""
    episodes = dataset.meta.episodes
    return [int(row["length"]) for row in (episodes.values() if isinstance(episodes, dict) else episodes)]


def subtask_texts(dataset: LeRobotDataset) -> dict[int, str]:
    """Return the texts of meta/subtasks.parquet by subtask_index; empty where LeRobot ignores them (0.6 and 2.1)."""
    if dataset.meta.info["codebase_version"] != "v3.0" or "subtask_index" not in dataset.meta.features:
        return {}
    table = pd.read_parquet(Path(dataset.root) / "meta/subtasks.parquet")
    return dict(zip(table["subtask_index"].tolist(), table.index.tolist(), strict=True))


def instruction(dataset: LeRobotDataset, episode: int) -> str:
    """Return the instruction of an episode."""
    return dataset.meta.episodes[episode]["tasks"][0]


def check_iteration(dataset: LeRobotDataset) -> None:
    """Load every frame once, in a shuffled loader with a worker."""
    options = {}
    if "language_persistent" in dataset.meta.features:
        from lerobot.utils.collate import lerobot_collate_fn

        options["collate_fn"] = lerobot_collate_fn
    start, indices = time.perf_counter(), []
    for batch in torch.utils.data.DataLoader(dataset, batch_size=16, shuffle=True, num_workers=1, **options):
        indices += batch["index"].tolist()
        for key in rgb_keys(dataset):
            assert 0 <= batch[key].min() <= batch[key].max() <= 1
    assert sorted(indices) == list(range(len(dataset)))
    seconds = time.perf_counter() - start
    say(f"iterated {len(indices)} frames in {seconds:.1f} s, {len(indices) / seconds:.0f} per second")


def rgb_keys(dataset: LeRobotDataset) -> list[str]:
    """Return the keys of the RGB cameras."""
    return [key for key in dataset.meta.camera_keys if key not in getattr(dataset.meta, "depth_keys", ())]


def check_subgoals(dataset: LeRobotDataset, root: Path, source: Path | None) -> None:
    """Resolve the sub-goal of each frame as LeRobot's recipes do, and compare it with the RoboCAS dataset."""
    from lerobot.datasets.language_render import active_at

    rows, found = dataset.hf_dataset.with_format(None), {}
    for row in rows:
        active = active_at(row["timestamp"], persistent=row["language_persistent"], style="subtask", role="assistant")
        found.setdefault(row["episode_index"], []).append(active["content"])
    paraphrases = [row["content"] for row in rows[0]["language_persistent"] if row["style"] == "task_aug"]
    boxes = sum(len(row["language_events"]) for row in rows) // 2
    say(f"sub-goals of episode 0: {list(dict.fromkeys(found[0]))}; {len(paraphrases)} instructions; {boxes} boxes")
    for episode, folder in robocas_folders(root, source).items():
        with np.load(folder / "episode_info.npz") as arrays:
            assert found[episode] == arrays["step_lang_goals"].tolist(), folder
        say(f"  episode {episode}: the sub-goals of all {len(found[episode])} frames are those of {folder.name}")


def check_depth(dataset: LeRobotDataset, root: Path, source: Path | None) -> None:
    """Compare depth of the first, middle and last frame of each episode with the RoboCAS dataset."""
    start = np.cumsum([0, *lengths(dataset)])
    folders = robocas_folders(root, source)
    for key in dataset.meta.depth_keys:
        item = dataset[len(dataset) // 2][key]
        say(f"  {key}: {tuple(item.shape)}, {item.min():g} to {item.max():g} mm")
        worst = 0.0
        for episode, folder in folders.items():
            count = lengths(dataset)[episode]
            for step in (0, count // 2, count - 1):
                camera = key.removeprefix("observation.images.").removesuffix("_depth")
                stored = np.asarray(Image.open(folder / camera / "depth" / f"{step:04d}.png"), np.float64)
                depth = dataset[int(start[episode]) + step][key][0].numpy()
                worst = max(worst, float(np.abs(depth - np.minimum(stored, MAX_DEPTH_MM)).max()))
        assert worst <= PRECISION_MM, (key, worst)
        if folders:
            say(f"    largest difference from {source}: {worst:g} mm (stated precision: {PRECISION_MM} mm)")


def robocas_folders(root: Path, source: Path | None) -> dict[int, Path]:
    """Return the folder of each episode in the RoboCAS dataset, matched by the recording."""
    if source is None:
        return {}
    theirs = json.loads((source / "conversion.json").read_text())["episodes"]
    places = {entry["recording"]: source / f"episode_{int(number):07d}" for number, entry in theirs.items()}
    ours = json.loads((root / "meta/robocas/conversion.json").read_text())["episodes"]
    return {episode: places[entry["recording"]] for episode, entry in enumerate(ours)}


class StubHandler(BaseHTTPRequestHandler):
    """OpenAI-compatible server that gives one answer to every prompt."""

    def do_GET(self) -> None:  # noqa: N802
        """Reply with the list of models, which has one entry."""
        self.reply({"object": "list", "data": [{"id": "stub", "object": "model"}]})

    def do_POST(self) -> None:  # noqa: N802
        """Reply to a prompt with the fixed answer."""
        self.rfile.read(int(self.headers["Content-Length"]))
        message = {"role": "assistant", "content": json.dumps(ANSWERS)}
        choice = {"index": 0, "message": message, "finish_reason": "stop"}
        self.reply({"id": "0", "object": "chat.completion", "created": 0, "model": "stub", "choices": [choice]})

    def reply(self, content: dict) -> None:
        """Send a dictionary as JSON."""
        body = json.dumps(content).encode()
        self.send_response(200)
        self.send_header("Content-Type", "application/json")
        self.send_header("Content-Length", str(len(body)))
        self.end_headers()
        self.wfile.write(body)

    def log_message(self, *_: object) -> None:
        """Do not log requests."""


def check_annotations(dataset: LeRobotDataset, root: Path) -> None:
    """Run lerobot-annotate on a copy against a stub server: it must add speech and keep the other rows."""
    server = ThreadingHTTPServer(("127.0.0.1", 0), StubHandler)
    threading.Thread(target=server.serve_forever, daemon=True).start()
    with tempfile.TemporaryDirectory() as folder:
        copy = Path(copytree(root, Path(folder) / root.name))
        run(
            "lerobot-annotate",
            f"--root={copy}",
            f"--vlm.api_base=http://127.0.0.1:{server.server_port}/v1",
            "--vlm.model_id=stub",
            "--vlm.auto_serve=false",
            "--video_backend=pyav",
            "--plan.enabled=false",  # the dataset has sub-goals and paraphrases
            "--vqa.enabled=false",  # the dataset has boxes
            "--interjections.max_interjections_per_episode=0",  # they need the module plan
        )
        server.shutdown()
        annotated = load(copy)
        before, after = (data.hf_dataset.with_format(None) for data in (dataset, annotated))
        spoken = 0
        for ours, theirs in zip(before, after, strict=True):
            assert theirs["language_persistent"] == ours["language_persistent"]
            added = [row for row in theirs["language_events"] if row["style"] is None]
            assert [row for row in theirs["language_events"] if row["style"] is not None] == ours["language_events"]
            spoken += len(added)
            assert all(SPEECH in json.dumps(row["tool_calls"]) for row in added)
        assert spoken == dataset.num_episodes
        annotated[0]
    say(f"lerobot-annotate added {spoken} rows of speech and kept all other rows")


def check_train(dataset: LeRobotDataset, root: Path) -> None:
    """Train ACT for a few steps by lerobot-train, on RGB and state: ACT has no input for depth."""
    keys = ["observation.state", *rgb_keys(dataset)]
    inputs = {key: feature_of(dataset.meta.features[key]) for key in keys}
    with tempfile.TemporaryDirectory() as folder:
        out = Path(folder) / "act"
        start = time.perf_counter()
        run(
            "lerobot-train",
            "--dataset.repo_id=robocas/check",
            f"--dataset.root={root}",
            "--dataset.video_backend=pyav",
            "--policy.type=act",
            "--policy.device=cpu",
            "--policy.push_to_hub=false",
            "--policy.pretrained_backbone_weights=null",  # nothing is downloaded
            "--policy.chunk_size=8",
            "--policy.n_action_steps=8",
            "--policy.dim_model=128",
            f"--policy.input_features={json.dumps(inputs)}",
            f"--steps={TRAIN_STEPS}",
            "--batch_size=2",
            "--num_workers=0",
            f"--output_dir={out}",
        )
        assert (out / "checkpoints/last/pretrained_model/model.safetensors").is_file()
    say(f"lerobot-train: {TRAIN_STEPS} steps of ACT in {time.perf_counter() - start:.0f} s")


def feature_of(feature: dict) -> dict:
    """Convert a feature of a dataset to a feature of a policy configuration: images are (C, H, W)."""
    shape = list(feature["shape"])
    if feature["dtype"] == "video":
        return {"type": "VISUAL", "shape": [shape[2], *shape[:2]]}
    return {"type": "STATE", "shape": shape}


def run(name: str, *words: str) -> None:
    """Run a command of LeRobot; print its output if it fails."""
    done = subprocess.run([Path(sys.executable).with_name(name), *words], capture_output=True, text=True, check=False)
    if done.returncode:
        sys.exit(f"{name} failed\n{done.stdout[-4000:]}\n{done.stderr[-4000:]}")


def say(text: str) -> None:
    """Print a line without buffering."""
    print(text, flush=True)


if __name__ == "__main__":
    main(Path(sys.argv[1]), Path(sys.argv[2]) if len(sys.argv) > 2 else None)
