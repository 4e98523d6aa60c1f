"""LeRobot's own policies (ACT, diffusion, ...) on our data and in our evaluation; docs/baselines_lerobot.md.

``prepare`` narrows a dataset to what the policy socket sends, and runs here; ``serve`` runs in LeRobot's environment
and serves a checkpoint; ``policy`` has the observations that both use.
"""
