"""Solvers of ordinary differential equations that stop at state events: what steps a model-exchange FMU.

Owns the contract of a solver, a forward Euler for checks, and CVode of SUNDIALS, whose libraries FMPy ships. A solver
knows nothing of FMI modes; the event iteration is `fmu_mesh.instances.fmi.model_exchange.model_exchange`.
"""

from __future__ import annotations

import ctypes
import math
import sys
from collections.abc import Callable
from contextlib import suppress
from functools import cache
from types import SimpleNamespace
from typing import Any, Final, NoReturn, Protocol

import numpy as np
from fmpy.fmi1 import FMICallException

from ....rings import native
from ....simtime import resolvable, steps_between
from ..fmu_values import DISCARD, SolverFailed
from .model_calls import LibraryCalls, ModelCalls

__all__ = ["CVodeSolver", "EulerSolver", "ModelPlace", "Solver"]

# Who meets here: one thread, in three languages. Python calls CVode, CVode calls back (`_RHS`, `_ROOT`), and this calls
# the FMU. The library of C has these two functions, too; then no evaluation needs Python, and the floats are the same.
# No exception may cross C: it is kept in `_failure`, or by the library as the call that has failed; CVode is told to
# give up, and it is raised once CVode has returned. ctypes gives up the lock of the interpreter meanwhile, so other
# threads run; none of them may use this solver. ADR 11 says why each instance has a solver of its own, and why no step
# of it crosses a communication point.
#
# What may go wrong, and what is done about it:
#
# * A failed evaluation is no failed step. `discard` asks for a smaller step (FMI 2.0, 2.1.3); everything else ends the
#   run, with what the FMU said and not with what CVode makes of it.
# * A linear input that turns does not fit the history of CVode, which gives up after seven failed error tests in one
#   step. It begins anew there, once, from the states at the start of the step.
# * An indicator that is exactly 0 is not above 0 (FMI 2.0, 3.1). CVode would stop at exactly 0, where the model sees no
#   event yet, and would not see it rise from there. So CVode never sees a 0.
# * A model with indicators and without states gets a constant state, so that there is something to step.
# * CVode does not say that a derivative is NaN, only that its tests fail or that time stands still. `_give_up` asks
#   again.
#
# The history of CVode is no part of a state of FMI. Whoever takes a state therefore restarts the solver, so that the
# run goes on as it would from that state.
#
# Not taken: the declarations of `fmpy.sundials`. They lack the stop time and the handlers of errors, and make an object
# of each vector that a callback gets.

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


class ModelPlace(Protocol):
    """Where a model is."""

    time: float  # in s
    next_event: float  # the time of its next time event in s
    terminated: bool  # whether the FMU has asked to end the simulation; it is not advanced then

    def note(self, **changed: float) -> None:
        """Change what is given by its name."""


class _PlainPlace:
    time = 0.0
    next_event = math.inf
    terminated = False

    def note(self, **changed: float) -> None:
        self.__dict__.update(changed)


class Solver:
    """Base of the solvers, and the one for a model with neither continuous states nor event indicators.

    Call sequence: `restart`, then `step` from where the last one ended, and `complete` if the FMU is told of completed
    steps; `restart` after every event; `close`.
    """

    def __init__(self, equations: ModelCalls) -> None:
        self.at: ModelPlace = _PlainPlace()
        self._equations = equations

    @property
    def place(self) -> tuple[float, ...]:
        """What a state keeps besides that of the model."""
        return ()

    def resume(self, place: tuple[float, ...]) -> None:
        """Continue where `place` was, after `restart`."""

    def restart(self) -> None:
        """Begin anew, at the states and nominal values of the model."""

    def step(self, time: float, stop: float) -> tuple[float, bool]:
        """One step from ``time`` to ``stop`` (s) at most: the time reached, and whether an event indicator crossed 0.

        The model is at that time and at its states afterwards.

        Raises:
            SolverFailed: the solver gave up; the text says why.
            FMICallException: the model could not be evaluated.
        """
        return stop, False  # the event loop puts a model without states there

    def complete(self) -> tuple[bool, bool]:
        """Tell the FMU that the step is completed; whether it asks for event mode, and to end the simulation."""
        return self._equations.completed_step()

    def doubt(self) -> str | None:
        """Why another solver would be better for this model, in words, the first time; None if nothing says so."""
        return None

    def close(self) -> None:
        """Free its memory."""

    def _give_up(self, why: str, time: float, states: int) -> NoReturn:
        """End with ``why``, and with a derivative that is not finite at a time in s, at these states."""
        derivatives = np.zeros(self._equations.n_states)
        with suppress(FMICallException):
            self._equations.set_point(time, states)
            self._equations.get_derivatives(derivatives.ctypes.data)
        wrong = np.flatnonzero(~np.isfinite(derivatives))
        told = f"; derivative {wrong[0] + 1} of {len(derivatives)} is {derivatives[wrong[0]]}" if len(wrong) else ""
        raise SolverFailed(f"{why}{told}")


class EulerSolver(Solver):
    """Forward Euler; events are seen at the end of the step in which they happen.

    ``maximum_step_size`` is in s; None: one step per communication step.
    """

    def __init__(self, equations: ModelCalls, maximum_step_size: float | None) -> None:
        super().__init__(equations)
        self._maximum = maximum_step_size
        self._states = np.zeros(equations.n_states)
        self._derivatives = np.zeros(equations.n_states)
        self._indicators = np.zeros(equations.n_indicators)
        self._before = np.zeros(equations.n_indicators, dtype=bool)
        self._steps: list[float] = []

    def restart(self) -> None:
        """Take the states of the model."""
        if self._equations.n_states:
            self._equations.get_states(self._states.ctypes.data)
        self._before = self._above_zero()
        self._steps = []

    def step(self, time: float, stop: float) -> tuple[float, bool]:
        """See `Solver.step`."""
        if not self._steps or self._steps[0] != stop:
            self._steps = self._divided(time, stop)
        end = self._steps.pop()
        if self._equations.n_states:
            self._equations.get_derivatives(self._derivatives.ctypes.data)
            self._states += (end - time) * self._derivatives
        self._equations.set_point(end, self._states.ctypes.data)
        above = self._above_zero()
        crossed = bool((above != self._before).any())
        self._before = above
        return end, crossed

    def _divided(self, time: float, stop: float) -> list[float]:
        """The ends of equal steps, no longer than allowed, from ``time`` to ``stop``; the first is the last item."""
        if self._maximum is None:
            return [stop]
        whole = steps_between(time, stop, self._maximum)
        count = max(1, math.ceil((stop - time) / self._maximum) if whole is None else whole)
        return [stop, *(time + (stop - time) * (number / count) for number in range(count - 1, 0, -1))]

    def _above_zero(self) -> np.ndarray[Any, np.dtype[np.bool_]]:
        if self._equations.n_indicators:
            self._equations.get_indicators(self._indicators.ctypes.data)
        return self._indicators > 0.0


class CVodeSolver(Solver):
    """CVode of SUNDIALS: variable-order BDF with root finding, one internal step per call and never beyond ``stop``.

    ``maximum_step_size`` is in s; None: as long as the communication step.

    So the FMU learns of every completed integrator step (FMI 2.0, 3.2.2), and no input is extrapolated beyond its
    communication step. The absolute tolerances are the relative one times the nominal values (FMI 2.0, 3.2.1).
    """

    def __init__(self, equations: ModelCalls, relative_tolerance: float, maximum_step_size: float | None) -> None:
        super().__init__(equations)
        self._relative_tolerance = relative_tolerance
        self._n = max(equations.n_states, 1)
        self._api = api = _sundials()
        self._said = ""
        self._failure: BaseException | None = None
        data = api.N_VGetArrayPointer

        def told(_line: int, function: bytes, _file: bytes, message: bytes, *_rest: object) -> None:
            self._said = f"{function.decode(errors='replace')}: {message.decode(errors='replace')}"

        self._calls: LibraryCalls | None = None
        if native.library is None:
            self._rhs = _RHS(lambda time, x, dx, _: self._guarded(self._derivatives, time, data(x), data(dx)))
            self._root = _ROOT(lambda time, x, z, _: self._guarded(self._indicators, time, data(x), z))
        else:
            self._calls = LibraryCalls(equations, vector_data=ctypes.cast(data, ctypes.c_void_p))
            self._rhs = native.library.equations_derivatives
            self._root = native.library.equations_indicators
        self._handler = _HANDLER(told)
        self._is_new = True  # whether CVode begins anew in its next step
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

    def restart(self) -> None:
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
        if self._calls is not None:
            self._check(api.CVodeSetUserData(self._memory, ctypes.addressof(self._calls.table)))
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
            self._fail(time, self._said or f"CVode returned {flag}")
        self._stalled = 0 if resolvable(time, reached.value) else self._stalled + 1
        if self._stalled > _MOST_STALLED:
            self._fail(time, f"CVode makes no progress at t = {time:.12g} s")
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
        if self._calls is not None:
            self._calls.follow()
            self._calls.table.note(status=0)
        if self._is_new:
            self._begin(time)
        self._check(self._api.CVodeSetStopTime(self._memory, stop))
        return int(self._api.CVode(self._memory, stop, self._x, ctypes.byref(reached), _CV_ONE_STEP))

    def _fail(self, time: float, why: str) -> NoReturn:
        """End with what the model failed with during this step, or else with ``why``."""
        if self._failure is not None:
            raise self._failure
        if self._calls is not None and self._calls.table.status:
            raise self._calls.failure()
        self._give_up(why, time, self._x_data)

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

    def _check(self, flag: int) -> None:
        if flag != 0:
            raise SolverFailed(self._said or f"CVode could not be set up ({flag})")


def _view(address: int, count: int) -> np.ndarray[Any, np.dtype[np.float64]]:
    return np.ctypeslib.as_array((ctypes.c_double * count).from_address(address))


@cache
def _sundials() -> Any:  # noqa: ANN401 ctypes has no types
    """The functions of SUNDIALS that `CVodeSolver` calls, from the libraries that FMPy ships."""
    try:
        from fmpy.sundials import libraries  # noqa: PLC0415 the import loads the libraries: only if needed
    except OSError as error:
        raise SolverFailed(
            f"cvode is not there: FMPy ships no SUNDIALS for this platform ({error}); `solver: {{name: dopri5}}` needs "
            "the library of C, `euler` nothing"
        ) from error

    pointer, real, integer, size = ctypes.c_void_p, ctypes.c_double, ctypes.c_int, ctypes.c_int64
    types: dict[Any, dict[str, tuple[Any, ...]]] = {  # of the result, and of each argument
        libraries.sundials_core: {
            "SUNContext_Create": (integer, integer, pointer),
            "SUNContext_Free": (integer, pointer),
            "SUNContext_ClearErrHandlers": (integer, pointer),
            "SUNContext_PushErrHandler": (integer, pointer, _HANDLER, pointer),
            "N_VGetArrayPointer": (pointer, pointer),
            "N_VDestroy": (None, pointer),
            "SUNMatDestroy": (None, pointer),
            "SUNLinSolFree": (integer, pointer),
        },
        libraries.sundials_nvecserial: {"N_VNew_Serial": (pointer, size, pointer)},
        libraries.sundials_sunmatrixdense: {"SUNDenseMatrix": (pointer, size, size, pointer)},
        libraries.sundials_sunlinsoldense: {"SUNLinSol_Dense": (pointer, pointer, pointer, pointer)},
        libraries.sundials_cvode: {
            "CVodeCreate": (pointer, integer, pointer),
            "CVodeInit": (integer, pointer, _RHS, real, pointer),
            "CVodeReInit": (integer, pointer, real, pointer),
            "CVodeSVtolerances": (integer, pointer, real, pointer),
            "CVodeSetLinearSolver": (integer, pointer, pointer, pointer),
            "CVodeSetUserData": (integer, pointer, pointer),
            "CVodeSetNoInactiveRootWarn": (integer, pointer),
            "CVodeRootInit": (integer, pointer, integer, _ROOT),
            "CVodeSetMaxStep": (integer, pointer, real),
            "CVodeSetMaxHnilWarns": (integer, pointer, integer),
            "CVodeSetStopTime": (integer, pointer, real),
            "CVode": (integer, pointer, real, pointer, pointer, integer),
            "CVodeFree": (None, pointer),
        },
    }
    return SimpleNamespace(
        **{
            name: ctypes.CFUNCTYPE(*function)((name, library))
            for library, functions in types.items()
            for name, function in functions.items()
        }
    )
