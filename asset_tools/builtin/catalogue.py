"""Read the products of the builtin pack from ``products/*.yaml``.

These files refer to functions by name.
"""

from __future__ import annotations

import inspect
import zlib
from collections.abc import Callable, Iterable
from functools import cache
from pathlib import Path
from typing import Annotated, Any, ClassVar, Literal, Union, get_type_hints

import numpy as np
import trimesh
from pydantic import Field, create_model, model_validator

from asset_tools.builtin import animals, bottles, fruits, labels, planes, shapes, skins, tools, toys
from asset_tools.builtin.mesh import Shape
from asset_tools.builtin.models import Model
from robocas_ms3.assets.manifest import Fraction, Name, Positive
from robocas_ms3.core.documents import DocumentError, load_yaml
from robocas_ms3.core.errors import AssetError
from robocas_ms3.core.strict_model import StrictModel, parse

FOLDER = Path(__file__).parent / "products"


class Formula(StrictModel):
    """Call in a product file: ``kind`` names a function, the other keys are its keyword arguments."""

    function: ClassVar[Callable[..., Any]]

    kind: str

    def __call__(self, *given: Any) -> Any:
        """Call the function with the positional arguments ``given`` and the keyword arguments of the file."""
        named = {key: getattr(self, key) for key in type(self).model_fields if key != "kind"}
        function = type(self).function
        return function(**named)(*given) if isinstance(function, type) else function(*given, **named)


def _any_of(functions: Iterable[Callable[..., Any]]) -> Any:
    """Return the pydantic type of a key whose value is a call of one of ``functions``.

    The name of a function in a file is its Python name without ``make_`` or ``paint_``.
    """
    kinds: list[Any] = []
    for function in functions:
        kind = function.__name__.removeprefix("make_").removeprefix("paint_").lower()
        types = get_type_hints(function, include_extras=True)
        fields: dict[str, Any] = {"kind": (Literal[kind], ...)}
        for name, parameter in inspect.signature(function).parameters.items():
            if parameter.kind is parameter.KEYWORD_ONLY:
                default = ... if parameter.default is parameter.empty else parameter.default
                fields[name] = types[name], default
        kinds.append(create_model(kind, __base__=Formula, **fields))
        kinds[-1].function = function
    return Annotated[Union[tuple(kinds)], Field(discriminator="kind")]  # noqa: UP007  (of a tuple)


# (size) -> Shape
ShapeFormula = _any_of(
    (
        *(
            shapes.make_carton,
            shapes.make_soap_bar,
            shapes.make_can,
            shapes.make_canister,
            shapes.make_jar,
            shapes.make_mug,
        ),
        *(
            bottles.make_bottle,
            bottles.make_flip_top_bottle,
            bottles.make_drink_bottle,
            bottles.make_pump_bottle,
            bottles.make_upended_bottle,
        ),
        *(
            bottles.make_tube,
            fruits.make_fruit,
            fruits.make_round_fruit,
            fruits.make_banana,
            toys.make_ball,
            toys.make_rubiks_cube,
        ),
    )
)
# (Shape, Generator) -> Image
PaintFormula = _any_of(
    (
        *(labels.paint_carton, labels.paint_wrapped, labels.paint_tube, labels.paint_soap, labels.paint_mug),
        *(skins.Fruit, skins.paint_banana, toys.paint_racquetball, toys.paint_rubiks_cube),
    )
)
MODELS: dict[str, Callable[[], Model]] = {
    maker.__name__.removeprefix("make_"): maker
    for maker in (
        *(
            tools.make_power_drill,
            tools.make_scissors,
            tools.make_screwdriver,
            tools.make_padlock,
            tools.make_computer_mouse,
        ),
        *(planes.make_red_airplane, planes.make_airliner, planes.make_biplane),
        *(animals.make_large_elephant, animals.make_small_elephant, animals.make_rhinoceros, animals.make_monkey),
    )
}
ModelName = Literal[tuple(MODELS)]


class Product(StrictModel):
    """Entry of a product file: an object of the builtin pack.

    Attributes:
        id: id of the object, which is the key of the entry.
        category: category of the object.
        size: outer size (x, y, z) in the usual pose, m.
        mass: mass in kg.
        roughness: roughness of the surface, 0 (mirror) to 1 (chalk).
        graspnet_id: number of the object in GraspNet-1Billion that this object replaces.
        spoken: name in instructions; empty: the id with spaces.
        hollow: whether the object is a container or thin. If so, the hulls are judged by surface distance, not by IoU.
        shape: function that makes the shape from ``size``.
        paint: function that paints the texture of the shape.
        model: name in ``MODELS`` of a model, which replaces ``shape`` and ``paint``.
    """

    id: Name
    category: Name
    size: tuple[Positive, Positive, Positive]
    mass: Positive
    roughness: Fraction = 0.45
    graspnet_id: int
    spoken: str = ""
    hollow: bool = False
    shape: ShapeFormula | None = None  # pyright: ignore[reportInvalidTypeForm]
    paint: PaintFormula | None = None  # pyright: ignore[reportInvalidTypeForm]
    model: ModelName | None = None  # pyright: ignore[reportInvalidTypeForm]

    @model_validator(mode="after")
    def _made_somehow(self) -> Product:
        parts = [part for part in (self.shape, self.paint) if part is not None]
        if len(parts) != (0 if self.model else 2):
            raise ValueError("expected either the keys shape and paint, or the key model")
        return self

    @property
    def name(self) -> str:
        """Name in instructions, such as "sugar box"."""
        return self.spoken or self.id.replace("_", " ")

    def build(self) -> tuple[Shape, trimesh.Trimesh]:
        """Return the shape of the object and its textured mesh for rendering; deterministic."""
        made: Any = MODELS[self.model]() if self.model else self
        shape = made.shape(self.size)
        image = made.paint(shape, np.random.default_rng(zlib.crc32(self.id.encode())))
        return shape, shape.make_textured_mesh(image, roughness=self.roughness)


@cache
def load_builtin_products() -> dict[str, Product]:
    """Read the products of the builtin pack; return id -> product."""
    return load_products(FOLDER)


def load_products(folder: Path) -> dict[str, Product]:
    """Read the products from all YAML files of a folder; return id -> product.

    Raises:
        AssetError: a file cannot be read, an id occurs twice, or a key is unknown, missing or invalid.
    """
    found: dict[str, Product] = {}
    for path in sorted(folder.glob("*.yaml")):
        try:
            entries = load_yaml(path)
        except (OSError, DocumentError) as error:
            raise AssetError("cannot read the products", where=path, expected="a YAML file", found=error) from error
        if not isinstance(entries, dict) or not all(isinstance(entry, dict) for entry in entries.values()):
            expected, found_type = "a mapping of ids to mappings", type(entries).__name__
            raise AssetError("invalid file of products", where=path, expected=expected, found=found_type)
        for id_, entry in entries.items():
            if id_ in found:
                raise AssetError("two products have the same id", where=path, found=id_, fix="Rename one of them.")
            found[id_] = parse(Product, {**entry, "id": id_}, AssetError, where=f"{path}, {id_}")
    return found
