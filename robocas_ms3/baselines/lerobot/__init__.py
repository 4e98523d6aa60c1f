"""LeRobot's policies (ACT, diffusion and others), trained on LeRobot datasets and evaluated over the policy socket.

`prepare` reduces a dataset to the data that the policy socket sends. `serve` serves a checkpoint; it runs in LeRobot's
environment. `policy` has the observations that both use. More: docs/baselines_lerobot.md.
"""
