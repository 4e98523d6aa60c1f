"""Record an episode with the scripted policy, then replay its actions: the same states come out.

python examples/02_record.py OUT
"""

import sys
from pathlib import Path

from robocas_ms3.demos.episode import EpisodeSettings, recordable_config
from robocas_ms3.demos.generate import generate
from robocas_ms3.demos.replay import replay
from robocas_ms3.scenes.config import load_task_config

out = Path(sys.argv[1])
name = "pick_table_scattered"
config = recordable_config(load_task_config(name), name)
settings = EpisodeSettings("pick", config, "builtin", control_freq=20, max_attempts=20, keep_recoveries=False)
summary = generate(settings, out, episodes=1, first_seed=0, overwrite=True)
print(f"{summary.episodes} of {summary.seeds} seeds succeeded; {summary.mean_steps:.0f} steps")

for result in replay(summary.trajectory):
    print(f"replayed seed {result.seed}: success {result.success}, states differ by {result.state_error}")
