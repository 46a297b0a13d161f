"""The solver CVode of SUNDIALS, whose libraries FMPy ships."""

from __future__ import annotations

import ctypes
import sys
from collections.abc import Callable
from contextlib import suppress
from typing import Any, Final, NoReturn

import numpy as np
from fmpy.fmi1 import FMICallException

from ..fmu_values import DISCARD
from .solver import Equations, SolverFailed, resolvable

__all__ = ["CVodeSolver"]

_RHS = ctypes.CFUNCTYPE(ctypes.c_int, ctypes.c_double, ctypes.c_void_p, ctypes.c_void_p, ctypes.c_void_p)
_ROOT = _RHS
_HANDLER = ctypes.CFUNCTYPE(
    None,
    ctypes.c_int,
    ctypes.c_char_p,
    ctypes.c_char_p,
    ctypes.c_char_p,
    ctypes.c_int,
    ctypes.c_void_p,
    ctypes.c_void_p,
)
_CV_BDF: Final = 2
_CV_ONE_STEP: Final = 2
_CV_ROOT_RETURN: Final = 2
_FAILED_TESTS: Final = (-3, -4)
"""CV_ERR_FAILURE, CV_CONV_FAILURE: too many failures in one step, of the error test or of the corrector."""
_RETRY_SMALLER: Final = 1
_GIVE_UP: Final = -1
_MOST_STALLED: Final = 100
"""Solver steps in a row that do not advance time beyond rounding."""


class CVodeSolver:
    """CVode of SUNDIALS: variable-order BDF with root finding, one internal step per call and never beyond ``stop``.

    So the FMU learns of every completed integrator step (FMI 2.0, 3.2.2), and no input is extrapolated beyond its
    communication step. The absolute tolerances are the relative one times the nominal values (FMI 2.0, 3.2.1).

    Args:
        equations: the model; one without states gets a constant one, so that its event indicators are watched.
        relative_tolerance: relative tolerance of the local error.
        maximum_step_size: in s; None: as long as the communication step.
    """

    def __init__(self, equations: Equations, relative_tolerance: float, maximum_step_size: float | None) -> None:
        self._equations = equations
        self._relative_tolerance = relative_tolerance
        self._n = max(equations.n_states, 1)
        self._api = api = _sundials()
        self._said = ""
        self._failure: BaseException | None = None
        self._rhs = _RHS(self._on_rhs)
        self._root = _ROOT(self._on_root)
        self._handler = _HANDLER(self._on_error)
        self._is_new = True
        """Whether CVode begins anew in its next step."""
        self._started = False
        self._stalled = 0
        self._context = ctypes.c_void_p()
        self._check(api.SUNContext_Create(0, ctypes.byref(self._context)))
        self._check(api.SUNContext_ClearErrHandlers(self._context))  # the default one writes to standard error
        self._check(api.SUNContext_PushErrHandler(self._context, self._handler, None))
        self._x = api.N_VNew_Serial(self._n, self._context)
        self._tolerances = api.N_VNew_Serial(self._n, self._context)
        self._x_data = api.N_VGetArrayPointer(self._x)
        self._states = _view(self._x_data, self._n)
        self._nominals = _view(api.N_VGetArrayPointer(self._tolerances), self._n)
        self._matrix = api.SUNDenseMatrix(self._n, self._n, self._context)
        self._linear = api.SUNLinSol_Dense(self._x, self._matrix, self._context)
        self._memory = ctypes.c_void_p(api.CVodeCreate(_CV_BDF, self._context))
        self._maximum = maximum_step_size

    def restart(self, time: float) -> None:  # noqa: ARG002 the Protocol
        """See `Solver.restart`."""
        self._is_new = True
        if self._equations.n_states:
            self._equations.get_states(self._x_data)
            self._equations.get_nominals(self._nominals.ctypes.data)
        else:
            self._states[:] = 1.0
            self._nominals[:] = 1.0
        np.abs(self._nominals, out=self._nominals)
        self._nominals[self._nominals == 0.0] = 1.0
        self._nominals *= self._relative_tolerance

    def _begin(self, time: float) -> None:
        """Let CVode begin anew."""
        self._is_new = False
        api = self._api
        if self._started:
            self._check(api.CVodeReInit(self._memory, time, self._x))
            self._check(api.CVodeSVtolerances(self._memory, self._relative_tolerance, self._tolerances))
            return
        self._check(api.CVodeInit(self._memory, self._rhs, time, self._x))
        self._check(api.CVodeSVtolerances(self._memory, self._relative_tolerance, self._tolerances))
        self._check(api.CVodeSetLinearSolver(self._memory, self._linear, self._matrix))
        self._check(api.CVodeSetNoInactiveRootWarn(self._memory))
        if self._equations.n_indicators:
            self._check(api.CVodeRootInit(self._memory, self._equations.n_indicators, self._root))
        if self._maximum is not None:
            self._check(api.CVodeSetMaxStep(self._memory, self._maximum))
        self._check(api.CVodeSetMaxHnilWarns(self._memory, -1))  # they would go to standard output
        self._started = True

    def step(self, time: float, stop: float) -> tuple[float, bool]:
        """See `Solver.step`."""
        was_new, states = self._is_new, self._states.copy()
        reached = ctypes.c_double()
        flag = self._call(time, stop, reached)
        if flag in _FAILED_TESTS and not was_new:
            # The line of an input has turned too much for the history.
            self._is_new, self._states[:] = True, states
            flag = self._call(time, stop, reached)
        if flag < 0:
            self._give_up(time, self._said or f"CVode returned {flag}")
        self._stalled = 0 if resolvable(time, reached.value) else self._stalled + 1
        if self._stalled > _MOST_STALLED:
            self._give_up(time, f"CVode makes no progress at t = {time:.12g} s")
        self._equations.set_point(reached.value, self._x_data)
        return reached.value, flag == _CV_ROOT_RETURN

    def close(self) -> None:
        """See `Solver.close`."""
        if not self._memory.value:
            return
        self._api.CVodeFree(ctypes.byref(self._memory))
        self._api.SUNLinSolFree(self._linear)
        self._api.SUNMatDestroy(self._matrix)
        self._api.N_VDestroy(self._x)
        self._api.N_VDestroy(self._tolerances)
        self._api.SUNContext_Free(ctypes.byref(self._context))
        self._memory = ctypes.c_void_p()

    def _call(self, time: float, stop: float, reached: ctypes.c_double) -> int:
        """Call CVode for one of its steps; its result, which is negative after a failure."""
        self._failure = None
        if self._is_new:
            self._begin(time)
        self._check(self._api.CVodeSetStopTime(self._memory, stop))
        return int(self._api.CVode(self._memory, stop, self._x, ctypes.byref(reached), _CV_ONE_STEP))

    def _give_up(self, time: float, why: str) -> NoReturn:
        """End with what the model failed with during this step, or else with ``why``, and a derivative that is NaN."""
        if self._failure is not None:
            raise self._failure
        derivatives = np.zeros(self._n)
        with suppress(FMICallException):
            self._derivatives(time, self._x_data, derivatives.ctypes.data)
        wrong = np.flatnonzero(~np.isfinite(derivatives))
        told = f"; derivative {wrong[0] + 1} of {self._n} is {derivatives[wrong[0]]}" if len(wrong) else ""
        raise SolverFailed(f"{why}{told}")

    def _on_rhs(self, time: float, x: int, dx: int, _data: int | None) -> int:
        get_pointer = self._api.N_VGetArrayPointer
        return self._guarded(self._derivatives, time, get_pointer(x), get_pointer(dx))

    def _on_root(self, time: float, x: int, z: int, _data: int | None) -> int:
        return self._guarded(self._indicators, time, self._api.N_VGetArrayPointer(x), z)

    def _derivatives(self, time: float, x: int, dx: int) -> None:
        self._equations.set_point(time, x)
        if self._equations.n_states:
            self._equations.get_derivatives(dx)
        else:
            ctypes.memset(dx, 0, 8)

    def _indicators(self, time: float, x: int, z: int) -> None:
        self._equations.set_point(time, x)
        self._equations.get_indicators(z)
        # An event is a change between "above 0" and "not above 0" (FMI 2.0, 3.1). CVode would stop at exactly 0, before
        # an indicator is above it, and from there it would not see it rise.
        values = _view(z, self._equations.n_indicators)
        values[values == 0.0] = -sys.float_info.min

    def _guarded(self, evaluate: Callable[[float, int, int], None], time: float, x: int, result: int) -> int:
        """Evaluate the model from C: nothing may be raised there. Discard asks for a smaller step (FMI 2.0, 2.1.3)."""
        try:
            evaluate(time, x, result)
        except FMICallException as error:
            self._failure = error
            return _RETRY_SMALLER if error.status == DISCARD else _GIVE_UP
        except BaseException as error:  # noqa: BLE001 it is raised again as soon as CVode has returned
            self._failure = error
            return _GIVE_UP
        return 0

    def _on_error(
        self,
        _line: int,
        function: bytes,
        _file: bytes,
        message: bytes,
        _code: int,
        _data: int | None,
        _context: int | None,
    ) -> None:
        self._said = f"{function.decode(errors='replace')}: {message.decode(errors='replace')}"

    def _check(self, flag: int) -> None:
        if flag != 0:
            raise SolverFailed(self._said or f"CVode could not be set up ({flag})")


def _view(address: int, count: int) -> np.ndarray[Any, np.dtype[np.float64]]:
    return np.ctypeslib.as_array((ctypes.c_double * count).from_address(address))


class _Sundials:
    """The functions of SUNDIALS that `CVodeSolver` calls, from the libraries that FMPy ships."""

    def __init__(self) -> None:
        from fmpy.sundials import libraries  # noqa: PLC0415 the import loads the libraries: only if needed

        pointer, real, integer = ctypes.c_void_p, ctypes.c_double, ctypes.c_int
        core, cvode = libraries.sundials_core, libraries.sundials_cvode

        def declare(library: Any, name: str, result: Any, *arguments: Any) -> Any:  # noqa: ANN401 ctypes has no types
            return ctypes.CFUNCTYPE(result, *arguments)((name, library))

        self.SUNContext_Create = declare(core, "SUNContext_Create", integer, integer, pointer)
        self.SUNContext_Free = declare(core, "SUNContext_Free", integer, pointer)
        self.SUNContext_ClearErrHandlers = declare(core, "SUNContext_ClearErrHandlers", integer, pointer)
        self.SUNContext_PushErrHandler = declare(core, "SUNContext_PushErrHandler", integer, pointer, _HANDLER, pointer)
        self.N_VNew_Serial = declare(libraries.sundials_nvecserial, "N_VNew_Serial", pointer, ctypes.c_int64, pointer)
        self.N_VGetArrayPointer = declare(core, "N_VGetArrayPointer", pointer, pointer)
        self.N_VDestroy = declare(core, "N_VDestroy", None, pointer)
        self.SUNDenseMatrix = declare(
            libraries.sundials_sunmatrixdense, "SUNDenseMatrix", pointer, ctypes.c_int64, ctypes.c_int64, pointer
        )
        self.SUNMatDestroy = declare(core, "SUNMatDestroy", None, pointer)
        self.SUNLinSol_Dense = declare(
            libraries.sundials_sunlinsoldense, "SUNLinSol_Dense", pointer, pointer, pointer, pointer
        )
        self.SUNLinSolFree = declare(core, "SUNLinSolFree", integer, pointer)
        self.CVodeCreate = declare(cvode, "CVodeCreate", pointer, integer, pointer)
        self.CVodeInit = declare(cvode, "CVodeInit", integer, pointer, _RHS, real, pointer)
        self.CVodeReInit = declare(cvode, "CVodeReInit", integer, pointer, real, pointer)
        self.CVodeSVtolerances = declare(cvode, "CVodeSVtolerances", integer, pointer, real, pointer)
        self.CVodeSetLinearSolver = declare(cvode, "CVodeSetLinearSolver", integer, pointer, pointer, pointer)
        self.CVodeSetNoInactiveRootWarn = declare(cvode, "CVodeSetNoInactiveRootWarn", integer, pointer)
        self.CVodeRootInit = declare(cvode, "CVodeRootInit", integer, pointer, integer, _ROOT)
        self.CVodeSetMaxStep = declare(cvode, "CVodeSetMaxStep", integer, pointer, real)
        self.CVodeSetMaxHnilWarns = declare(cvode, "CVodeSetMaxHnilWarns", integer, pointer, integer)
        self.CVodeSetStopTime = declare(cvode, "CVodeSetStopTime", integer, pointer, real)
        self.CVode = declare(cvode, "CVode", integer, pointer, real, pointer, pointer, integer)
        self.CVodeFree = declare(cvode, "CVodeFree", None, pointer)


_loaded: list[_Sundials] = []


def _sundials() -> _Sundials:
    if not _loaded:
        _loaded.append(_Sundials())
    return _loaded[0]
