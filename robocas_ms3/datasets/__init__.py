"""RoboCAS and LeRobot datasets: read, convert, validate, statistics, and samples for training.

Public names are imported from this package at first use; without the names of `training`, PyTorch is not loaded.
"""

from typing import TYPE_CHECKING

from robocas_ms3.core.lazy import make_lazy_exports

if TYPE_CHECKING:
    from robocas_ms3.datasets.actions import ActionScale as ActionScale
    from robocas_ms3.datasets.actions import to_joint_positions as to_joint_positions
    from robocas_ms3.datasets.candidate_images.images_file import CandidateImages as CandidateImages
    from robocas_ms3.datasets.checks.dataset import ValidationReport as ValidationReport
    from robocas_ms3.datasets.checks.dataset import validate as validate
    from robocas_ms3.datasets.checks.violation import Violation as Violation
    from robocas_ms3.datasets.conversion.convert import convert as convert
    from robocas_ms3.datasets.conversion.settings import ConversionResult as ConversionResult
    from robocas_ms3.datasets.conversion.settings import ConversionSettings as ConversionSettings
    from robocas_ms3.datasets.conversion.settings import WrittenEpisode as WrittenEpisode
    from robocas_ms3.datasets.formats import Format as Format
    from robocas_ms3.datasets.formats import open_source as open_source
    from robocas_ms3.datasets.images.image_files import ImageOptions as ImageOptions
    from robocas_ms3.datasets.lerobot.convert import convert_lerobot as convert_lerobot
    from robocas_ms3.datasets.lerobot.reader import LeRobotDataset as LeRobotDataset
    from robocas_ms3.datasets.sources.episode_source import EpisodeSource as EpisodeSource
    from robocas_ms3.datasets.sources.episode_source import SourceEpisode as SourceEpisode
    from robocas_ms3.datasets.sources.reader import Dataset as Dataset
    from robocas_ms3.datasets.training.candidate_dataset import CandidateDataset as CandidateDataset
    from robocas_ms3.datasets.training.candidate_dataset import CandidateOptions as CandidateOptions
    from robocas_ms3.datasets.training.options import SampleOptions as SampleOptions
    from robocas_ms3.datasets.training.torch_dataset import RoboCASDataset as RoboCASDataset

__getattr__, __dir__, __all__ = make_lazy_exports(
    __name__,
    {
        "robocas_ms3.datasets.actions": ["ActionScale", "to_joint_positions"],
        "robocas_ms3.datasets.candidate_images.images_file": ["CandidateImages"],
        "robocas_ms3.datasets.checks.dataset": ["ValidationReport", "validate"],
        "robocas_ms3.datasets.checks.violation": ["Violation"],
        "robocas_ms3.datasets.conversion.convert": ["convert"],
        "robocas_ms3.datasets.conversion.settings": ["ConversionResult", "ConversionSettings", "WrittenEpisode"],
        "robocas_ms3.datasets.formats": ["Format", "open_source"],
        "robocas_ms3.datasets.images.image_files": ["ImageOptions"],
        "robocas_ms3.datasets.lerobot.convert": ["convert_lerobot"],
        "robocas_ms3.datasets.lerobot.reader": ["LeRobotDataset"],
        "robocas_ms3.datasets.sources.episode_source": ["EpisodeSource", "SourceEpisode"],
        "robocas_ms3.datasets.sources.reader": ["Dataset"],
        "robocas_ms3.datasets.training.candidate_dataset": ["CandidateDataset", "CandidateOptions"],
        "robocas_ms3.datasets.training.options": ["SampleOptions"],
        "robocas_ms3.datasets.training.torch_dataset": ["RoboCASDataset"],
    },
)
