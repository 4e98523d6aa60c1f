"""Read annotation files ``<id>.yaml`` of PartNet-Mobility models: surfaces, handles and joints."""

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
"""m or rad; largest limit of a joint and largest coordinate."""

Coordinate = Annotated[float, Field(ge=-LARGEST, le=LARGEST)]
Scale = Annotated[float, Field(ge=1e-4, le=1e4)]


class HandleAnnotation(StrictModel):
    """Grasp of a moving part: width, and pose of the TCP in the furniture's frame, joints closed; m."""

    joint: str
    position: Vec3
    wxyz: Quaternion
    width: Positive


class JointAnnotation(StrictModel):
    """Properties of a joint that replace the properties in the URDF."""

    mass: Positive | None = Field(
        default=None, description="mass of the moved part, kg; none: estimated from the volume"
    )
    friction: NonNegative | None = None
    damping: NonNegative | None = None
    closed: Annotated[float, Field(ge=-1e6, le=1e6)] | None = Field(
        default=None, description="closed position in the units of the URDF"
    )
    limits: tuple[Coordinate, Coordinate] | None = Field(
        default=None, description="m or rad, relative to the closed position"
    )
    fixed: bool = Field(default=False, description="fix the joint in its closed position")


class ModelAnnotation(StrictModel):
    """Content of an annotation file.

    A surface of a moving part has the name of the part's link in the URDF as ``link``. A surface of the fixed body has
    no ``link``.
    """

    name: Annotated[str, Field(min_length=1)]
    category: Annotated[str, Field(min_length=1)]
    origin_lift: Coordinate
    scale: Scale = Field(default=1.0, description="metres per unit of the model; all other values are in metres")
    mass: Positive | None = Field(default=None, description="kg; none: the furniture is fixed")
    surfaces: dict[Name, Surface] = {}
    handles: dict[Name, HandleAnnotation] = {}
    joints: dict[str, JointAnnotation] = {}


def find_annotation(model_id: str, folder: Path | None = None) -> ModelAnnotation:
    """Load the annotation of a model from the user's folder, or, if there is none, the bundled annotation.

    Args:
        model_id: name of the model's folder.
        folder: folder of the user's annotations, or None.

    Raises:
        AssetError: the annotation is missing or invalid.
    """
    places = [home / f"{model_id}.yaml" for home in (folder, BUNDLED_ANNOTATIONS) if home is not None]
    for path in places:
        if path.is_file():
            return load_annotation(path)
    bundled = ", ".join(sorted(path.stem for path in BUNDLED_ANNOTATIONS.glob("*.yaml")))
    raise AssetError(
        "no annotation of this model",
        where=model_id,
        expected=f"{model_id}.yaml in the folder given by --annotations, or a bundled annotation ({bundled})",
        fix="`robocas assets import-partnet DIR --template` prints a template.",
    )


def load_annotation(path: Path) -> ModelAnnotation:
    """Read an annotation file.

    Raises:
        AssetError: the file cannot be read, or a key is unknown, missing or invalid.
    """
    try:
        data = load_yaml(path)
    except (OSError, DocumentError) as error:
        raise AssetError("cannot read the annotation", where=path, expected="a YAML file", found=error) from error
    return parse(ModelAnnotation, data, AssetError, where=path, about="invalid annotation")
