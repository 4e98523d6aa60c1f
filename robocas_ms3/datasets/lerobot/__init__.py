"""LeRobot datasets v3.0: written, read and checked without ``lerobot``; see docs/lerobot.md."""
