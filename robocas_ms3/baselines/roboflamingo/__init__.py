"""RoboFlamingo, the paper's second baseline: an adapter for its own package, which wants an environment of its own."""
