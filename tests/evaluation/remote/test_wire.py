import contextlib

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

msgpack = pytest.importorskip("msgpack")

from robocas_ms3.core.errors import WireError
from robocas_ms3.evaluation.remote import wire
from robocas_ms3.evaluation.remote.wire import decode_message, encode_message

SCALARS = (
    st.none() | st.booleans() | st.integers(-(2**63), 2**64 - 1) | st.floats(allow_nan=False) | st.text() | st.binary()
)
DTYPES = (
    hnp.boolean_dtypes()
    | hnp.integer_dtypes()
    | hnp.unsigned_integer_dtypes()
    | hnp.floating_dtypes(sizes=(16, 32, 64))
)
ARRAYS = hnp.arrays(DTYPES, hnp.array_shapes(min_dims=0, max_dims=4, min_side=0, max_side=4))
VALUES = st.recursive(
    SCALARS, lambda inner: st.lists(inner, max_size=4) | st.dictionaries(st.text(), inner, max_size=4), max_leaves=12
)


@given(VALUES)
def test_values_round_trip(value):
    assert decode_message(encode_message(value)) == value


@given(ARRAYS)
def test_arrays_round_trip(array):
    back = decode_message(encode_message({"a": [array]}))["a"][0]
    assert back.dtype == array.dtype.newbyteorder("=")
    assert back.flags.writeable
    np.testing.assert_array_equal(back, array)


@given(ARRAYS)
def test_messages_are_compatible_with_openpi(array):
    openpi = pytest.importorskip("openpi_client.msgpack_numpy")
    np.testing.assert_array_equal(openpi.unpackb(encode_message(array)), array)
    assert encode_message(array) == openpi.packb(array)
    if array.size:
        scalar = array.reshape(-1)[0]
        np.testing.assert_array_equal(
            decode_message(openpi.packb(scalar)), decode_message(encode_message(scalar))
        )  # NaN is NaN


@pytest.mark.parametrize(
    "value",
    [
        np.array([None]),
        np.array(["text"]),
        np.array([1j]),
        np.zeros(2, np.dtype([("x", "f4")])),
        np.array(["2020-01-01"], "datetime64[D]"),
        np.zeros(1, np.longdouble),
        {1, 2},
        object(),
        2**70,
    ],
    ids=lambda value: type(value).__name__,
)
def test_values_that_cannot_be_encoded(value):
    with pytest.raises(WireError, match="cannot encode"):
        encode_message(value)


def array(data=bytes(8), dtype="<f4", shape=(2,), **more):
    named = {b"__ndarray__": True, b"data": data, b"dtype": dtype, b"shape": shape}
    return msgpack.packb({**named, **{key.encode(): value for key, value in more.items()}})


@pytest.mark.parametrize(
    "data",
    [
        array(dtype="|O"),
        array(dtype="O8"),
        array(dtype="<U2"),
        array(dtype="<c8"),
        array(dtype="<f1"),
        array(dtype="f4,f4"),
        array(dtype=["<f4"]),
        array(shape=(3,)),
        array(shape=(-2,)),
        array(shape=(2.0,)),
        array(shape=2),
        array(shape=(True, 2)),
        array(shape=(1,) * 9),
        array(data=b"", shape=(0, 2**31)),
        array(data=b"", shape=(0, *[2**31 - 1] * 3)),
        array(data="text"),
        array(other=1),
        msgpack.packb({b"__ndarray__": True}),
        msgpack.packb({b"__npgeneric__": True, b"data": "x", b"dtype": "<f4"}),
        msgpack.packb({b"__npgeneric__": True, b"data": 1, b"dtype": "|O"}),
        msgpack.packb({b"key": 1}),
        msgpack.packb({1: 1}, strict_types=False),
        msgpack.packb(msgpack.ExtType(5, b"")),
        msgpack.packb(msgpack.Timestamp(1)),
        b"",
        b"\xc1",
        b"\xa2\xff\xff",
        msgpack.packb(1) * 2,
        b"\x91" * 2000 + b"\x90",
        msgpack.packb([1] * 10_001),
        msgpack.packb([[1] * 9_000] * 12),
        msgpack.packb({str(number): 1 for number in range(1_001)}),
        b"\xdd\xff\xff\xff\xff",
    ],
)
def test_invalid_messages_are_refused(data):
    with pytest.raises(WireError):
        decode_message(data)


def test_depth_and_size_are_bounded():
    value = 1
    for _ in range(wire.MAX_DEPTH):
        value = [value]
    assert decode_message(encode_message(value)) == value
    with pytest.raises(WireError, match="too many levels"):
        decode_message(encode_message([value]))
    with pytest.raises(WireError, match="too large"):
        decode_message(bytes(11), max_bytes=10)


def test_decoded_bools_are_zero_or_one():
    back = decode_message(array(data=b"\x02\x00", dtype="|b1"))
    assert back.tolist() == [True, False]
    assert back.view(np.uint8).tolist() == [1, 0]


@given(VALUES | ARRAYS, st.data())
def test_damaged_message_gives_a_value_or_an_error(value, draw):
    data = bytearray(encode_message({"a": value, "b": np.zeros((2, 2), np.float32)}))
    for place in draw.draw(st.lists(st.integers(0, len(data) - 1), min_size=1, max_size=4)):
        data[place] = draw.draw(st.integers(0, 255))
    with contextlib.suppress(WireError):
        decode_message(bytes(data))
