"""The products of the builtin pack, as ``products/*.yaml`` has them; the formulas they name are code."""

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
    """A function, or a class of functions, by its name (``kind``); the other keys are its keyword arguments."""

    function: ClassVar[Callable[..., Any]]

    kind: str

    def __call__(self, *given: Any) -> Any:
        """What the function makes of it."""
        named = {key: getattr(self, key) for key in type(self).model_fields if key != "kind"}
        function = type(self).function
        return function(**named)(*given) if isinstance(function, type) else function(*given, **named)


def _any_of(functions: Iterable[Callable[..., Any]]) -> Any:
    """Type of a key that names one of these."""
    kinds: list[Any] = []
    for function in functions:
        kind = function.__name__.removeprefix("paint_").lower()
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
        *(shapes.carton, shapes.soap_bar, shapes.can, shapes.canister, shapes.jar, shapes.mug),
        *(bottles.bottle, bottles.flip_top_bottle, bottles.drink_bottle, bottles.pump_bottle, bottles.upended_bottle),
        *(bottles.tube, fruits.fruit, fruits.round_fruit, fruits.banana, toys.ball, toys.rubiks_cube),
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
    maker.__name__: maker
    for maker in (
        *(tools.power_drill, tools.scissors, tools.screwdriver, tools.padlock, tools.computer_mouse),
        *(planes.red_airplane, planes.airliner, planes.biplane),
        *(animals.large_elephant, animals.small_elephant, animals.rhinoceros, animals.monkey),
    )
}
ModelName = Literal[tuple(MODELS)]


class Product(StrictModel):
    """One object of the pack: what a file says of it.

    Attributes:
        id: its folder's name, and its key in the file. category: its kind.
        size: outer size (x, y, z), upright or in its usual pose, m.
        mass: kg.
        roughness: of the surface, 0 mirror to 1 chalk.
        graspnet_id: of the object of GraspNet-1Billion that it replaces.
        spoken: name for language; empty: made of the id.
        hollow: a container, or thin: its hulls are judged by distance, not by volume.
        shape: makes the shape of that size. paint: makes its texture.
        model: of ``MODELS``, makes both.
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
            raise ValueError("a product has a shape and a paint, or a model")
        return self

    @property
    def name(self) -> str:
        """For language: 'sugar box'."""
        return self.spoken or self.id.replace("_", " ")

    def build(self) -> tuple[Shape, trimesh.Trimesh]:
        """The shape, and the textured mesh to render; the same every time."""
        made: Any = MODELS[self.model]() if self.model else self
        shape = made.shape(self.size)
        image = made.paint(shape, np.random.default_rng(zlib.crc32(self.id.encode())))
        return shape, shape.textured(image, roughness=self.roughness)


@cache
def products() -> dict[str, Product]:
    """The products by id, as ``products/*.yaml`` has them."""
    return load_products(FOLDER)


def load_products(folder: Path) -> dict[str, Product]:
    """Read the products of a folder's files.

    Raises:
        AssetError: a file can't be read, an id is there twice, or a key is unknown, missing or wrong: naming the first.
    """
    found: dict[str, Product] = {}
    for path in sorted(folder.glob("*.yaml")):
        try:
            entries = load_yaml(path)
        except (OSError, DocumentError) as error:
            raise AssetError("products can't be read", where=path, found=error) from error
        if not isinstance(entries, dict) or not all(isinstance(entry, dict) for entry in entries.values()):
            raise AssetError("products can't be read", where=path, expected="a mapping of products by id")
        for id_, entry in entries.items():
            if id_ in found:
                raise AssetError("this product is there twice", where=f"{path}, {id_}")
            found[id_] = parse(Product, {**entry, "id": id_}, AssetError, where=f"{path}, {id_}")
    return found
