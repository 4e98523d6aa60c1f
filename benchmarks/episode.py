"""Where an episode's time goes, without rendering: reset, control step, planning. Prints JSON.

Run: python benchmarks/episode.py [--episodes 5] [--pack builtin]
"""

import json
import tempfile
import time
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np
import tyro

from robocas_ms3.demos.episode import EpisodeGenerator, EpisodeSettings


@dataclass
class Args:
    episodes: int = 5
    """Episodes to generate."""
    pack: str = "builtin"
    """Object pack."""


def main(args: Args) -> None:
    generator = EpisodeGenerator(EpisodeSettings("pick", "pick_table_scattered", args.pack))
    env = generator.env
    resets, steps = [], []
    for seed in range(5):
        start = time.perf_counter()
        env.reset(seed=seed)
        resets.append(time.perf_counter() - start)
        action = np.append(env.unwrapped.agent.robot.get_qpos()[0, 3:10].numpy(), 1.0).astype(np.float32)
        for _ in range(20):
            start = time.perf_counter()
            env.step(action)
            steps.append(time.perf_counter() - start)
    with tempfile.TemporaryDirectory() as folder:
        results = [generator.generate(seed, Path(folder), str(seed)) for seed in range(args.episodes)]
    parts = [asdict(result.seconds) for result in results]
    print(
        json.dumps(
            {
                "reset_ms": round(1000 * float(np.median(resets)), 1),
                "step_ms": round(1000 * float(np.median(steps)), 2),
                "success": sum(result.success for result in results),
                "episodes": len(results),
                "attempts": [result.attempts for result in results],
                "mean_steps": float(np.mean([result.steps for result in results])),
                "mean_seconds": {key: round(float(np.mean([p[key] for p in parts])), 2) for key in parts[0]},
            },
            indent=2,
        )
    )


if __name__ == "__main__":
    main(tyro.cli(Args))
