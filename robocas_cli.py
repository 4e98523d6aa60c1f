"""Entry point of the ``robocas`` command.

It stands outside the package because ``import robocas_ms3`` registers the environments, which imports ManiSkill and
takes seconds, and fails where ManiSkill is broken: just where ``robocas doctor`` has to run.
"""

import os
import sys


def main() -> None:
    """Run the ``robocas`` command line."""
    os.environ["ROBOCAS_DEFER_REGISTRATION"] = "1"
    if sys.argv[1:2] == ["generate"]:
        # Planning solves systems of 6 equations by the thousand: more threads than one only get in each other's way,
        # and where several processes share the cores, planning takes ten times as long.
        for name in ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS"):
            os.environ.setdefault(name, "1")
    from robocas_ms3.cli.main import main as run

    run()


if __name__ == "__main__":
    main()
