"""Convert small trajectories to LeRobot datasets, and read and change their files."""

from managing import edit, files_of
from synthetic import RayCaster

DATA = "data/chunk-000/file-000.parquet"
EPISODES = "meta/episodes/chunk-000/file-000.parquet"
VIDEO = "videos/observation.images.base_camera/chunk-000/file-000.mp4"
DEPTH = "depth/base_camera/chunk-000/file-000.mkv"
"""Files of a dataset of version 0.5."""


def convert(source, out, on_episode=None, **settings):
    """Convert with made-up images."""
    from robocas_ms3.datasets.conversion.settings import ConversionSettings
    from robocas_ms3.datasets.lerobot.convert import convert_lerobot  # needs the extra 'lerobot'

    settings = ConversionSettings(source, out, open_renderer=RayCaster, **settings)
    return convert_lerobot(settings, on_episode=on_episode)


def edit_json(root, name, change):
    """Change a JSON file in place."""
    edit(root / name, change)


__all__ = ["DATA", "DEPTH", "EPISODES", "VIDEO", "convert", "edit_json", "files_of"]
