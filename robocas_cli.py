"""Entry point of the ``robocas`` command.

It stands outside the package because ``import robocas_ms3`` registers the environments, which imports ManiSkill and
takes seconds, and fails where ManiSkill is broken: just where ``robocas doctor`` has to run.
"""

import os


def main() -> None:
    """Run the ``robocas`` command line."""
    os.environ["ROBOCAS_DEFER_REGISTRATION"] = "1"
    from robocas_ms3.cli.main import main as run

    run()


if __name__ == "__main__":
    main()
