"""Columns as lines of text: C and Python write the same characters, and no float could be shorter."""

from __future__ import annotations

import base64
import math
from decimal import Decimal
from typing import Any

import numpy as np
import orjson
import pytest
from numpy.typing import NDArray

from fmu_mesh.results.csv_file import NativeLines, python_lines
from fmu_mesh.rings.library import load_library
from fmu_mesh.variables.value_types import DTYPES, TYPES, Value, VariableType, is_text

ROWS = 16_384
NUMBERS: list[VariableType] = [type_ for type_ in TYPES if not is_text(type_)]

needs_library = pytest.mark.skipif(load_library() is None, reason="the library is not built for this platform")


def floats(bits: NDArray[np.uint64]) -> NDArray[np.float64]:
    values = bits.view(np.float64)
    return values[np.isfinite(values)]


def native(columns: list[NDArray[Any]]) -> bytes:
    lines = NativeLines(len(columns), ROWS)
    starts = range(0, len(columns[0]), ROWS)
    return b"".join(bytes(lines([column[first : first + ROWS] for column in columns])) for first in starts)


def one_by_one(columns: list[NDArray[Any]]) -> bytes:
    """What joining the texts of single values gives."""
    return "".join(",".join(map(text_of, row)) + "\n" for row in zip(*map(list, columns), strict=True)).encode()


def text_of(value: Any) -> str:  # noqa: ANN401 any type of NumPy
    match value:
        case np.bool_():
            return "true" if value else "false"
        case np.integer():
            return str(int(value))
        case np.floating():
            return orjson.dumps(float(value)).decode() if math.isfinite(value) else repr(float(value))
        case bytes():
            return base64.b64encode(value).decode()
        case _:
            return '"' + str(value).replace('"', '""') + '"'


def some(type_: VariableType, count: int) -> NDArray[Any]:
    """Values of all sizes, the least and the greatest ones among them; some hold for several rows."""
    random = np.random.default_rng(len(type_))
    dtype = np.dtype(DTYPES[type_])
    if type_ == "Boolean":
        return random.integers(0, 2, count).astype(bool)
    if dtype.kind == "f":
        values = random.integers(0, 256, count * dtype.itemsize, dtype=np.uint8).view(dtype)
        return np.where(random.random(count) < 0.1, random.choice([0.0, -0.0, 1.0, 1e7, 123456.75], count), values)
    limits = np.iinfo(dtype)
    values = random.integers(limits.min, limits.max, count, dtype=dtype, endpoint=True)
    values >>= random.integers(0, limits.bits, count).astype(dtype)
    values[:2] = limits.min, limits.max
    return np.repeat(values, random.integers(1, 4, count))[:count]


@needs_library
def test_ten_million_floats_are_the_text_of_orjson() -> None:
    random = np.random.default_rng(17)
    for _ in range(10):
        values = floats(random.integers(0, 2**64, 1_000_000, dtype=np.uint64))
        assert native([values]) == orjson_text(values)


def kinds_of_floats() -> dict[str, NDArray[np.float64]]:
    """Floats that are close to something special, where a method that is nearly right is wrong."""
    random = np.random.default_rng(18)
    count = 200_000
    exponents = np.repeat(np.arange(2047, dtype=np.uint64), 50) << np.uint64(52)
    mantissas = random.integers(0, 2**52, len(exponents), dtype=np.uint64)
    near = random.integers(-3, 4, len(exponents)).view(np.uint64)
    powers = np.array([float(f"1e{exponent}") for exponent in range(-323, 309)])
    short = np.array([float(f"{n}e{e}") for n, e in random.integers((1, -320), (10_000, 305), (count // 10, 2))])
    ends = np.array([5e-324, 2.2250738585072009e-308, 2.2250738585072014e-308, 1.7976931348623157e308])
    return {
        "every exponent": (exponents | mantissas).view(np.float64),
        "close to a power of two": floats(exponents + near),
        "one bit of the mantissa": (exponents | (np.uint64(1) << mantissas % np.uint64(52))).view(np.float64),
        "close to a power of ten": np.concatenate([np.nextafter(powers, 0), powers, np.nextafter(powers, 1e308)]),
        "close to few digits": np.concatenate([np.nextafter(short, 0), short, np.nextafter(short, 1e308)]),
        "integers": random.integers(0, 2**63, count).astype(np.float64),
        "integers above 2^53": random.integers(2**53, 2**60, count).astype(np.float64),
        "quarters, where two texts are equally near": random.integers(2**50, 2**53, count) / 4,
        "subnormal": random.integers(0, 2**52, count).view(np.float64),
        "times": np.arange(count) * 0.002,
        "the first and the last": np.concatenate([ends, -ends, [0.0, -0.0, 9007199254740993.0, 2.0**-44, 5e-5]]),
    }


@needs_library
@pytest.mark.parametrize("kind", kinds_of_floats())
def test_a_float_is_as_short_and_as_near_as_its_repr(kind: str) -> None:
    values = kinds_of_floats()[kind]

    text = native([values])

    assert text == orjson_text(values)
    for line, value in list(zip(text.decode().split(), values.tolist(), strict=True))[:: max(1, len(values) // 30_000)]:
        assert Decimal(line) == Decimal(repr(value))
        assert math.copysign(1, float(line)) == math.copysign(1, value)


def orjson_text(values: NDArray[np.float64]) -> bytes:
    numbers = orjson.dumps(np.ascontiguousarray(values), option=orjson.OPT_SERIALIZE_NUMPY)
    return numbers[1:-1].replace(b",", b"\n") + b"\n"


@needs_library
@pytest.mark.parametrize("type_", NUMBERS)
def test_c_and_python_write_the_same_numbers(type_: VariableType) -> None:
    count = 2_000
    columns = [np.arange(count) / 7, some(type_, count), some("Float64", count), some(type_, count)[::-1]]

    assert native(columns) == python_lines(columns) == one_by_one(columns)


@needs_library
def test_columns_are_read_where_they_lie() -> None:
    """The recorder gives columns of rings: rows lie behind each other there, and rings cannot be written."""
    rows = np.zeros(500, np.dtype([("stamp", "i8"), ("a", "f8"), ("b", "f4"), ("on", "?")]))
    rows["a"], rows["b"], rows["on"] = some("Float64", 500), some("Float32", 500), some("Boolean", 500)
    rows.flags.writeable = False
    columns = [np.arange(500) * 0.1, rows["a"], rows["b"], rows["on"], rows["a"][::-1]]

    assert native(columns) == python_lines(columns) == one_by_one(columns)


@needs_library
def test_value_that_holds_is_written_in_each_row_and_after_each_look() -> None:
    lines = NativeLines(3, 4)
    columns = [np.array([0.0, 1.0]), np.array([math.nan, math.nan]), np.array([-0.0, 0.0])]

    for _ in range(2):
        assert bytes(lines(columns)) == b"0.0,nan,-0.0\n1.0,nan,0.0\n"


@needs_library
@pytest.mark.parametrize(
    ("columns", "why"),
    [
        ([np.zeros(3), np.zeros(2)], "of another length"),
        ([np.zeros(3), np.zeros((3, 1))], "of another shape"),
        ([np.zeros(5), np.zeros(5)], "more rows than there is room for"),
    ],
)
def test_the_library_never_gets_columns_that_it_could_not_read_or_write(columns: list[NDArray[Any]], why: str) -> None:
    with pytest.raises(ValueError, match=f"{len(columns[0])} rows"):
        NativeLines(2, 4)(columns)
    assert why


@needs_library
def test_the_longest_texts_fit() -> None:
    values = np.full(8, -2.2250738585072014e-308)
    values[::2] = -np.nextafter(1e-4, 0)

    for columns in ([values] * 51, [values] * 600):  # of 600, not even one row has all its digits found at once
        assert bytes(NativeLines(len(columns), 8)(columns)) == one_by_one(columns)


@pytest.mark.parametrize("width", [1, 2, 3, 31, 200])
def test_python_writes_floats_in_lines_of_any_width(width: int) -> None:
    columns = list(some("Float64", 20 * width).reshape(width, 20))
    finite = [np.nan_to_num(column) for column in columns]

    for values in (columns, finite):
        assert python_lines(values) == one_by_one(values)


def test_texts_are_written_by_python() -> None:
    values: list[list[Value]] = [[0.0, math.inf], ['say "a"', "b,\n"], [b"\xff", b""], [1.5, math.nan]]
    columns = [np.array(values[0]), *(np.array(column, object) for column in values[1:3]), np.array(values[3])]

    assert python_lines(columns) == b'0.0,"say ""a""",/w==,1.5\ninf,"b,\n",,nan\n'
