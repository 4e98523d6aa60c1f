"""Adapters that run episodes of a protocol in the evaluation loops of vla-eval and LeRobot."""
