"""Serve a LeRobot checkpoint to ``robocas eval``; runs in LeRobot's environment, see scripts/serve_lerobot.sh.

    python -m robocas_ms3.baselines.lerobot.serve RUN [--port 8000] [--play N] [--device cpu]

It imports the socket and nothing that simulates; besides LeRobot it needs msgpack, websockets, pydantic, scipy, PyYAML
and platformdirs.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from importlib.metadata import version
from pathlib import Path
from typing import Any

from robocas_ms3.baselines.lerobot.policy import LeRobotPolicy
from robocas_ms3.core.documents import load_json
from robocas_ms3.core.errors import EvaluationError, RobocasError
from robocas_ms3.core.text import escape_controls, escape_log_lines, escape_tracebacks
from robocas_ms3.datasets.lerobot.schema import checksum
from robocas_ms3.evaluation.remote.server import PolicyServer

CHECKPOINT = "train/checkpoints/last/pretrained_model"
INFO = "dataset/meta/info.json"
"""In a folder of scripts/train_lerobot.sh."""


def open_checkpoint(checkpoint: Path, rate_hz: float, device: str, play: int | None) -> LeRobotPolicy:
    """Load a checkpoint of ``lerobot-train``."""
    if not (checkpoint / "config.json").is_file():
        fix = "Train first: bash scripts/train_lerobot.sh act DATASET RUN"
        raise EvaluationError("no checkpoint of LeRobot", where=checkpoint, expected="config.json", fix=fix)
    from lerobot.configs.policies import PreTrainedConfig  # pyright: ignore[reportMissingImports]
    from lerobot.policies.factory import (  # pyright: ignore[reportMissingImports]
        get_policy_class,
        make_pre_post_processors,
    )

    config: Any = PreTrainedConfig.from_pretrained(checkpoint)
    config.device = device
    if play is not None:
        config.n_action_steps = play
        try:
            config.__post_init__()
        except (ValueError, NotImplementedError) as error:
            raise EvaluationError("can't play so many", where="--play", found=f"{play}: {error}") from error
    model = get_policy_class(config.type).from_pretrained(checkpoint, config=config)
    model.eval()
    overrides = {"device_processor": {"device": device}}  # the checkpoint has that of the training
    before, after = make_pre_post_processors(config, checkpoint, preprocessor_overrides=overrides)
    inputs = {key: tuple(feature.shape) for key, feature in config.input_features.items()}
    about = {
        "lerobot": version("lerobot"),
        "type": config.type,
        "weights": checksum(checkpoint / "model.safetensors"),  # a result can't be continued with other weights
        "n_action_steps": config.n_action_steps,
    }
    return LeRobotPolicy(model, before, after, inputs, rate_hz, about)


def rate_of(info: Path) -> float:
    try:
        rate_hz = load_json(info)["fps"]
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise EvaluationError("no rate known", where=info, found=repr(error), fix="Pass --rate HZ.") from error
    if type(rate_hz) not in (int, float) or not 0 < rate_hz <= 1000:
        found, fix = str(rate_hz)[:80], "Pass --rate HZ."
        raise EvaluationError("no rate known", where=info, expected="fps from 0 to 1000", found=found, fix=fix)
    return float(rate_hz)


def main(words: Sequence[str] | None = None) -> int:
    parser = argparse.ArgumentParser(description="Serve a LeRobot checkpoint over the policy socket.")
    parser.add_argument("run", type=Path, help="folder of train_lerobot.sh, or a checkpoint's pretrained_model")
    parser.add_argument("--host", default="127.0.0.1", help="there is no password: keep to loopback, and tunnel")
    parser.add_argument("--port", type=int, default=8000)
    parser.add_argument("--device", default="cpu")
    parser.add_argument("--play", type=int, help="actions of a chunk that are played; default: as trained")
    parser.add_argument("--rate", type=float, help="actions a second; default: the dataset's in the run's folder")
    cfg = parser.parse_args(words)
    escape_log_lines()
    try:
        checkpoint = cfg.run if (cfg.run / "config.json").is_file() else cfg.run / CHECKPOINT
        rate_hz = cfg.rate if cfg.rate is not None else rate_of(cfg.run / INFO)
        policy = open_checkpoint(checkpoint, rate_hz, cfg.device, cfg.play)
        PolicyServer(policy, cfg.host, cfg.port).run(
            lambda url: print(escape_controls(f"{checkpoint} at {url}"), flush=True)
        )
    except RobocasError as error:
        print(escape_controls(f"error: {error}"), file=sys.stderr)
        return 1
    except KeyboardInterrupt:
        return 130
    return 0


if __name__ == "__main__":
    escape_tracebacks()
    sys.exit(main())
