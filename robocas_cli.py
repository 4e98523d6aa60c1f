"""Entry point of the ``robocas`` command."""

from robocas_ms3.cli.main import main

if __name__ == "__main__":
    main()
