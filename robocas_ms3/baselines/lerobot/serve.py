"""Serve a LeRobot checkpoint to ``robocas eval``, in LeRobot's Python environment.

    python -m robocas_ms3.baselines.lerobot.serve RUN [--port 8000] [--n-action-steps N] [--device cpu]

`scripts/serve_lerobot.sh` calls it. The module imports no simulator. In addition to LeRobot it needs msgpack,
websockets, pydantic, scipy, PyYAML and platformdirs.
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
from robocas_ms3.datasets.lerobot.schema import compute_checksum
from robocas_ms3.evaluation.remote.server import PolicyServer

CHECKPOINT = "train/checkpoints/last/pretrained_model"
INFO = "dataset/meta/info.json"
"""Paths in an output folder of scripts/train_lerobot.sh."""


def load_policy(checkpoint: Path, rate_hz: float, device: str, n_action_steps: int | None) -> LeRobotPolicy:
    """Load the policy in a checkpoint folder of ``lerobot-train``.

    n_action_steps: number of executed actions per chunk; None: that of the checkpoint.
    """
    if not (checkpoint / "config.json").is_file():
        fix = "Train a policy: bash scripts/train_lerobot.sh act DATASET OUT STEPS."
        raise EvaluationError("no LeRobot checkpoint in this folder", where=checkpoint, expected="config.json", fix=fix)
    from lerobot.configs.policies import PreTrainedConfig  # pyright: ignore[reportMissingImports]
    from lerobot.policies.factory import (  # pyright: ignore[reportMissingImports]
        get_policy_class,
        make_pre_post_processors,
    )

    config: Any = PreTrainedConfig.from_pretrained(checkpoint)
    config.device = device
    if n_action_steps is not None:
        config.n_action_steps = n_action_steps
        try:
            config.__post_init__()
        except (ValueError, NotImplementedError) as error:
            found = f"{n_action_steps}: {error}"
            raise EvaluationError("invalid number of actions", where="--n-action-steps", found=found) from error
    model = get_policy_class(config.type).from_pretrained(checkpoint, config=config)
    model.eval()
    overrides = {"device_processor": {"device": device}}  # instead of the device of the training
    preprocessor, postprocessor = make_pre_post_processors(config, checkpoint, preprocessor_overrides=overrides)
    inputs = {key: tuple(feature.shape) for key, feature in config.input_features.items()}
    description = {
        "lerobot": version("lerobot"),
        "type": config.type,
        "weights": compute_checksum(checkpoint / "model.safetensors"),  # a result is not continued with other weights
        "n_action_steps": config.n_action_steps,
    }
    return LeRobotPolicy(model, preprocessor, postprocessor, inputs, rate_hz, description)


def read_dataset_rate(info: Path) -> float:
    """Return the rate in Hz of a LeRobot dataset, from its ``info.json``."""
    try:
        rate_hz = load_json(info)["fps"]
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise EvaluationError(
            "cannot read the rate (fps) of the dataset", where=info, found=repr(error), fix="Pass --rate HZ."
        ) from error
    if type(rate_hz) not in (int, float) or not 0 < rate_hz <= 1000:
        found, fix = str(rate_hz)[:80], "Pass --rate HZ."
        expected = "fps above 0 and at most 1000"
        raise EvaluationError("invalid rate of the dataset", where=info, expected=expected, found=found, fix=fix)
    return float(rate_hz)


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command with these arguments (None: those of the process); return the exit status."""
    parser = argparse.ArgumentParser(description="Serve a LeRobot checkpoint over the policy socket.")
    parser.add_argument("run", type=Path, help="output folder of train_lerobot.sh, or pretrained_model of a checkpoint")
    parser.add_argument(
        "--host",
        default="127.0.0.1",
        help="address to listen on; the server has no password: keep the default and use an SSH tunnel",
    )
    parser.add_argument("--port", type=int, default=8000, help="port to listen on; default: 8000")
    parser.add_argument("--device", default="cpu", help="torch device of the policy; default: cpu")
    parser.add_argument(
        "--n-action-steps", type=int, metavar="N", help="number of executed actions per chunk; default: as trained"
    )
    parser.add_argument(
        "--rate", type=float, metavar="HZ", help="actions per second; default: the rate of the dataset in RUN"
    )
    cfg = parser.parse_args(argv)
    escape_log_lines()
    try:
        checkpoint = cfg.run if (cfg.run / "config.json").is_file() else cfg.run / CHECKPOINT
        rate_hz = cfg.rate if cfg.rate is not None else read_dataset_rate(cfg.run / INFO)
        policy = load_policy(checkpoint, rate_hz, cfg.device, cfg.n_action_steps)
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
