"""For a program in Python that takes part in a running mesh as an instance of the kind `outside`.

It calls the functions of `fmu_mesh/rings/outside.h`, whose contract holds here, too.
"""

from __future__ import annotations

import ctypes
from ctypes import byref, c_char_p, c_double, c_int64, c_void_p
from types import TracebackType
from typing import Any, Final, Self

from ...errors import CallRefused, ConfigurationError, FmuMeshError, MeshLost, UnknownName
from ...rings.library import load_library, why_no_library
from ...text import listed
from ...variables.value_types import Value, flattened

__all__ = ["Importer", "attach_as"]

_FLOATS: Final = (0, 1)
_BOOLEAN, _STRING = 10, 11
_WRONG, _ENDED = 1, 2


def attach_as(address: str | None = None, *, timeout: float = 10.0) -> Importer:
    """Take part in a running mesh as an instance of the kind `outside`.

    Args:
        address: `mesh/instance`, or the path of the socket; None: the environment variable FMU_MESH_CONNECT.
        timeout: how long to wait for a mesh that does not run yet, in s.

    Raises:
        MeshLost: there is no such instance, or another program is attached to it.
    """
    return Importer(address, timeout)


class Importer:
    """This program as an instance of a running mesh; use it in one thread, and with `with`.

    What is set holds from the current point on; `step` goes to the next one, and `get` returns what the mesh has there.
    Leaving the `with` detaches: before the last point, the run ends here, and without an error.
    """

    def __init__(self, address: str | None, timeout: float) -> None:
        self._handle: int | None = None
        path = load_library(to_step=False)
        if path is None:
            raise ConfigurationError(f"this needs the library of C, which is {why_no_library()}")
        self._library = library = ctypes.CDLL(path)
        functions: dict[str, Any] = {
            "attach": c_void_p,
            "name": c_char_p,
            "error": c_char_p,
            "time": c_double,
            "step_size": c_double,
            **dict.fromkeys(("count", "elements", "point"), c_int64),
        }
        for name, result in functions.items():
            getattr(library, f"outside_{name}").restype = result
        text = ctypes.create_string_buffer(600)
        own = address.encode() if address is not None else None
        self._handle = library.outside_attach(own, c_int64(int(timeout * 1e9)), text, ctypes.c_size_t(600))
        if self._handle is None:
            raise MeshLost(text.value.decode(), hint="`fmu-mesh ls` shows the meshes that run.")
        names = [self._call("name", n).decode() for n in map(c_int64, range(self._call("count")))]
        self._numbers = {name: n for n, name in enumerate(names)}

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.detach()

    @property
    def names(self) -> tuple[str, ...]:
        """The names of all variables, inputs first."""
        return tuple(self._numbers)

    @property
    def point(self) -> int:
        """The communication point where the instance is."""
        return int(self._call("point"))

    @property
    def time(self) -> float:
        """The time at this point, in s; known after `begin`."""
        return float(self._call("time"))

    @property
    def step_size(self) -> float:
        """The length of a step in s; known after `begin`."""
        return float(self._call("step_size"))

    def set(self, name: str, value: Value) -> None:
        """Set an output; an array as nested lists, row by row.

        Raises:
            CallRefused: it is an input, or has another type or size.
        """
        number, kind = self._variable(name)
        if kind == _STRING:
            self._check(self._call("set_string", number, str(value).encode()))
            return
        elements = flattened(value, _depth(value))
        word, element = ("float64", c_double) if kind in _FLOATS else ("int64", c_int64)
        values = (element * len(elements))(*elements)
        self._check(self._call(f"set_{word}", number, values, c_int64(len(elements))))

    def get(self, name: str) -> Any:  # noqa: ANN401 a value of its type
        """The value of a variable; an array as a flat list, row by row."""
        number, kind = self._variable(name)
        if kind == _STRING:
            text = c_char_p()
            self._check(self._call("get_string", number, byref(text)))
            return (text.value or b"").decode(errors="replace")
        size = self._call("elements", number)
        word, element = ("float64", c_double) if kind in _FLOATS else ("int64", c_int64)
        values = (element * size)()
        self._check(self._call(f"get_{word}", number, values, c_int64(size)))
        found = [bool(own) for own in values] if kind == _BOOLEAN else list(values)
        return found if size > 1 else found[0]

    def begin(self) -> None:
        """Give the outputs of Initialization Mode; afterwards the inputs are those at point 0. `step` calls it, too."""
        self._check(self._call("begin"))

    def step(self, steps: int = 1) -> bool:
        """Take steps with the outputs as they are; False: the run has ended."""
        result = self._call("step", c_int64(steps))
        if result != _ENDED:
            self._check(result)
        return bool(result != _ENDED)

    def detach(self) -> None:
        """Leave the mesh; may be called twice."""
        handle, self._handle = self._handle, None
        if handle is not None:
            self._library.outside_detach(c_void_p(handle))

    def _variable(self, name: str) -> tuple[c_int64, int]:
        if name not in self._numbers:
            raise UnknownName(f"there is no variable '{name}'", hint=f"There are {listed(self.names)}.")
        number = c_int64(self._numbers[name])
        return number, int(self._call("type", number))

    def _call(self, name: str, *arguments: Any) -> Any:  # noqa: ANN401 those of the function
        if self._handle is None:
            msg = "this program has detached"
            raise ValueError(msg)
        return getattr(self._library, f"outside_{name}")(c_void_p(self._handle), *arguments)

    def _check(self, result: int) -> None:
        if result:
            text = self._call("error").decode()
            raise CallRefused(text) if result == _WRONG else FmuMeshError(text) if result == _ENDED else MeshLost(text)


def _depth(value: object) -> int:
    return 1 + _depth(value[0]) if isinstance(value, list) and value else int(isinstance(value, list))
