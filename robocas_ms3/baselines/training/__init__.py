"""Training runs: `session.train_run` starts or continues a run, `RunFolder` writes its files.

`supervised.train_supervised` and `ppo.train.train_ppo` are the two training loops.
"""
