"""Record one episode of the task pick with the scripted policy, replay the recorded actions, and compare the states.

python examples/02_record.py OUT
"""

import sys
from pathlib import Path

from robocas_ms3.demos import EpisodeSettings, GenerateSettings, ReplaySettings, generate, replay

episode = EpisodeSettings("pick", "pick_table_scattered")  # task and task configuration
summary = generate(GenerateSettings(episode, Path(sys.argv[1]), episodes=1, overwrite=True))
print(f"{summary.episodes} of {summary.seeds} seeds succeeded; {summary.mean_steps:.0f} steps")

# The replay steps a new environment with the recorded actions.
for result in replay(ReplaySettings(summary.trajectory)):
    print(f"replayed seed {result.seed}: success {result.success}, largest state difference {result.state_error}")
