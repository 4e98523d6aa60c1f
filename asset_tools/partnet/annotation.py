"""What a PartNet-Mobility model doesn't say of itself: a YAML file beside it, ``<id>.yaml``."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

from pydantic import Field

from robocas_ms3.assets.manifest import Name, NonNegative, Positive, Quaternion, Surface, Vec3
from robocas_ms3.core.documents import DocumentError, load_yaml
from robocas_ms3.core.errors import AssetError
from robocas_ms3.core.strict_model import StrictModel, parse

BUNDLED_ANNOTATIONS = Path(__file__).parent / "annotations"
LARGEST = 100.0
"""m or rad: greatest limit of a joint, and greatest coordinate."""

Coordinate = Annotated[float, Field(ge=-LARGEST, le=LARGEST)]
Scale = Annotated[float, Field(ge=1e-4, le=1e4)]


class HandleAnnotation(StrictModel):
    """Where to take hold of what a joint moves: pose of the TCP in the furniture's frame, joints closed."""

    joint: str
    position: Vec3
    wxyz: Quaternion
    width: Positive


class JointAnnotation(StrictModel):
    """What to change about a joint."""

    mass: Positive | None = Field(default=None, description="of what it moves, kg; none: by volume")
    friction: NonNegative | None = None
    damping: NonNegative | None = None
    closed: Annotated[float, Field(ge=-1e6, le=1e6)] | None = Field(
        default=None, description="position at which it is closed, as the URDF counts"
    )
    limits: tuple[Coordinate, Coordinate] | None = Field(
        default=None, description="m or rad, counted from where it is closed"
    )
    fixed: bool = Field(default=False, description="hold it closed")


class ModelAnnotation(StrictModel):
    """The file. Surfaces name the URDF's links; those of the fixed body leave ``link`` out."""

    name: Annotated[str, Field(min_length=1)]
    category: Annotated[str, Field(min_length=1)]
    origin_lift: Coordinate
    scale: Scale = Field(default=1.0, description="metres of one unit of the model; all else here is in metres")
    mass: Positive | None = Field(default=None, description="kg; none: it can't be moved")
    surfaces: dict[Name, Surface] = {}
    handles: dict[Name, HandleAnnotation] = {}
    joints: dict[str, JointAnnotation] = {}


def find_annotation(model_id: str, folder: Path | None = None) -> ModelAnnotation:
    """The annotation of a model: the user's, or else the one that comes with this package.

    Args:
        model_id: name of the model's folder.
        folder: the user's annotations.

    Raises:
        AssetError: there is none, or it is wrong.
    """
    places = [home / f"{model_id}.yaml" for home in (folder, BUNDLED_ANNOTATIONS) if home is not None]
    for path in places:
        if path.is_file():
            return load_annotation(path)
    shipped = ", ".join(sorted(path.stem for path in BUNDLED_ANNOTATIONS.glob("*.yaml")))
    raise AssetError(
        "no annotation of this model",
        where=model_id,
        expected=f"{model_id}.yaml in the folder given by --annotations, or one of those shipped ({shipped})",
        fix="`robocas assets import-partnet DIR --template` prints one to start from.",
    )


def load_annotation(path: Path) -> ModelAnnotation:
    """Read an annotation file.

    Raises:
        AssetError: it can't be read, or a key is unknown, missing or wrong: naming the first.
    """
    try:
        data = load_yaml(path)
    except (OSError, DocumentError) as error:
        raise AssetError("the annotation can't be read", where=path, found=error) from error
    return parse(ModelAnnotation, data, AssetError, where=path, about="the annotation is wrong")
