"""LeRobot's policies (ACT, diffusion, ...), trained on exported datasets and evaluated over the policy socket.

``prepare`` reduces a dataset to what the policy socket sends. ``serve`` serves a checkpoint, in LeRobot's environment.
``policy`` has the observations that both use. More: docs/baselines_lerobot.md.
"""
