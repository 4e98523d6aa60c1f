"""Episodes of a protocol in the evaluation loops of other packages: vla-eval and LeRobot."""
