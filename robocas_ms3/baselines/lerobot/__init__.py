"""LeRobot's own policies (ACT, diffusion, ...) on our data and in our evaluation.

``prepare`` narrows a dataset to what the policy socket shows, and runs here; ``serve`` runs in LeRobot's environment
and answers the socket with a checkpoint; ``observations`` is what both hold to. docs/baselines_lerobot.md.
"""
