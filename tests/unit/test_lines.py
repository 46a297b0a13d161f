"""Numbers of a JSON array as lines: the compiled way and NumPy's give what joining them one by one gives."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
import orjson
import pytest

from fmu_mesh import compiled
from fmu_mesh.recorder import lines
from fmu_mesh.recorder.lines import in_lines


@pytest.fixture(params=["compiled", "NumPy"])
def way(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> Iterator[str]:
    if request.param == "NumPy":
        monkeypatch.setattr(compiled, "_llvm", lambda: None)
    lines._compiled.cache_clear()
    assert (lines._compiled() is None) == (request.param == "NumPy")
    yield request.param
    lines._compiled.cache_clear()


def expected(text: bytes, width: int) -> bytes:
    numbers = text[1:-1].split(b",")
    rows = [numbers[first : first + width] for first in range(0, len(numbers), width)]
    return b"".join(b",".join(row) + b"\n" for row in rows)


@pytest.mark.usefixtures("way")
@pytest.mark.parametrize("width", [1, 2, 3, 31, 64, 65, 200])
def test_every_line_has_its_numbers_wherever_the_text_ends(width: int) -> None:
    """Texts of every length between one block of characters and several, with commas at every place of a block."""
    for count in range(width, 300, width):
        for short in range(0, count, 7):
            numbers = [str(number % 10) * (1 + number % 5 * (number > short)) for number in range(count)]
            text = f"[{','.join(numbers)}]".encode()
            assert bytes(in_lines(text, width)) == expected(text, width)


@pytest.mark.usefixtures("way")
@pytest.mark.parametrize("width", [1, 3, 17])
def test_floats_of_all_lengths_are_left_as_they_are(width: int) -> None:
    bits = np.random.default_rng(width).integers(0, 2**64, size=1000 * width, dtype=np.uint64)
    values = np.nan_to_num(bits.view(np.float64), nan=0.5, posinf=1e300, neginf=-0.0)
    text = orjson.dumps(values, option=orjson.OPT_SERIALIZE_NUMPY)
    before = bytes(text)

    written = bytes(in_lines(text, width))

    assert written == expected(text, width)
    assert np.array(written.replace(b"\n", b",").split(b",")[:-1], dtype=np.float64).tobytes() == values.tobytes()
    assert text == before
