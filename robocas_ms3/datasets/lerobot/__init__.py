"""LeRobot datasets: writer, reader and checks without the package ``lerobot``; see docs/lerobot.md."""
