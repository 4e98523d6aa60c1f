"""Messages of validation errors: one line with key, expected and found values."""

from typing import Annotated, Literal

import pytest
from pydantic import AfterValidator, Field, TypeAdapter, ValidationError

from robocas_ms3.core.errors import AssetError, ConfigError
from robocas_ms3.core.strict_model import (
    FileName,
    StrictModel,
    check_name,
    did_you_mean,
    error_from_validation,
    list_invalid_values,
    parse,
    parse_json,
)


def _even(number: int) -> int:
    if number % 2:
        raise ValueError("an even number")
    return number


class Ball(StrictModel):
    kind: Literal["ball"] = "ball"
    radius: Annotated[float, Field(gt=0)]


class Crate(StrictModel):
    kind: Literal["crate"] = "crate"
    size: tuple[float, float]


class Shelf(StrictModel):
    name: Annotated[str, Field(pattern="^[a-z]+$")]
    things: list[Annotated[Ball | Crate, Field(discriminator="kind")]] = []
    names: dict[Annotated[str, Field(pattern="^[a-z]+$")], int] = {}
    boards: Annotated[int, AfterValidator(_even)] = 2


def said(**changes) -> str:
    with pytest.raises(ConfigError) as caught:
        parse(Shelf, {"name": "a", **changes}, ConfigError, where="shelf.yaml", about="no shelf")
    assert "\n" not in str(caught.value)
    return str(caught.value).removeprefix("shelf.yaml: no shelf: ")


@pytest.mark.parametrize(
    "values", [{"k" * 10**6: 1}, {"names": {"k " * 10**6: 1}}, {"things": [{"kind": "k" * 10**6}]}]
)
def test_messages_about_long_keys_are_short(values):  # a client of a policy server may send one of 60 MB
    with pytest.raises(ConfigError) as error:
        parse(Shelf, {"name": "a", **values}, ConfigError, where="")
    assert len(str(error.value)) < 500
    assert "k" * 3 in str(error.value).replace(" ", "")


def test_valid_values_are_read_from_yaml():
    shelf = parse(Shelf, {"name": "a", "things": [{"kind": "crate", "size": [1, 2]}]}, ConfigError, where="")
    assert shelf.things == [Crate(size=(1.0, 2.0))]
    with pytest.raises(ValidationError):
        shelf.name = "b"


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"name": "A"}, "invalid value for 'name' (expected a string like ^[a-z]+$, found 'A')"),
        ({"name": 1, "boards": "2"}, "invalid value for 'name' (expected a string, found 1). 1 more error."),
        ({"boards": 3}, "boards: an even number (found 3)"),
        (
            {"boards": 3, "bords": 2},
            "unknown key 'bords' (expected one of boards, name, names, things, found 'bords'). "
            "Did you mean boards? 1 more error.",
        ),
        ({"names": {"x y": 1}}, "invalid value for 'names.x y' (expected a string like ^[a-z]+$, found 'x y')"),
        (
            {"names": {"two\nlines": 1}},
            "invalid value for 'names.two lines' (expected a string like ^[a-z]+$, found 'two\\nlines')",
        ),
        (
            {"things": [{"kind": "ball", "radius": 0}]},
            "invalid value for 'things.0.radius' (expected greater than 0, found 0)",
        ),
        (
            {"things": [{"kind": "ball", "radius": float("inf")}]},
            "invalid value for 'things.0.radius' (expected a finite number, found inf)",
        ),
        (
            {"things": [{"kind": "bal"}]},
            "invalid value for 'things.0.kind' (expected one of ball, crate, found 'bal'). Did you mean ball?",
        ),
    ],
)
def test_messages_of_invalid_values(changes, message):
    assert said(**changes) == message


def test_a_value_without_json_type_is_reported_at_its_key():
    assert said(boards={1, 2}) == "invalid value for 'boards' (expected a whole number, found {'set': '{1, 2}'})"
    assert "a key that is not text" in said(names={(1, 2): 3})


def test_invalid_json_is_an_error():
    with pytest.raises(AssetError, match=r"^f: invalid JSON .found EOF while parsing"):
        parse_json(Shelf, '{"name": ', AssetError, where="f")
    assert parse_json(Shelf, b'{"name": "a"}', AssetError, where="f").boards == 2


def test_messages_with_custom_words_and_types():
    form = TypeAdapter(dict[str, Ball])
    with pytest.raises(ValidationError) as caught:
        form.validate_json('{"a": {"radius": "x"}, "b": 3}', strict=True)
    first, second = list_invalid_values(caught.value, form, {"float_type": "metres"})
    assert (first.key, first.expected, first.found, first.value) == ("a.radius", "metres", "'x'", "x")
    assert (second.key, second.kind) == ("b", "model_type")
    made = error_from_validation(caught.value, form, AssetError, where="f", fix="Make it again.")
    assert str(made) == ("f: invalid value for 'a.radius' (expected a number, found 'x'). 1 more error. Make it again.")


def test_did_you_mean_suggests_similar_names():
    assert did_you_mean("shelv", ["table", "shelf"]) == "Did you mean shelf?"
    assert did_you_mean("sofa", ["table", "shelf"]) == ""


class Form(StrictModel):
    name: FileName


@pytest.mark.parametrize("name", ["a", "link_0", "Left Tür 1", "a.b-c", "机器人", "x" * 200])
def test_valid_file_names_are_accepted(tmp_path, name):
    assert check_name(name, AssetError, where="file") == name
    (tmp_path / name).mkdir()
    assert [path.name for path in tmp_path.iterdir()] == [name]


@pytest.mark.parametrize(
    "name", ["", ".", "..", ".hidden", "a/b", "/a", "..\\a", "a\nb", "a\x00", "\x1b[31m", "\ud800", "ü" * 101]
)
def test_invalid_file_names_are_refused(name):
    with pytest.raises(AssetError) as raised:
        check_name(name, AssetError, where="file")
    assert raised.value.where == "file" and len(str(raised.value)) < 300
    with pytest.raises(AssetError):
        parse(Form, {"name": name}, AssetError, where="file")
