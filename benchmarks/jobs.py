"""The jobs: which system, which contestants, and how many points."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Literal

from benchmarks.chatty import CHATTY
from benchmarks.first_step import FMU, POINTS
from benchmarks.task import Algorithm, Member, System

__all__ = ["JOBS", "OTHER", "OURS", "Entry", "Job", "with_checkout"]

OURS = "fmu_mesh_launch"
KINDS = "fmu_mesh_kinds"
SWEEP = "fmu_mesh_sweep"
STEPPED = "fmu_mesh_environment"
OTHER = ", other checkout"
"""The end of the label of a row that another checkout runs."""

_MODULES_NEED = {
    "c_program": ("fmpy",),
    "c_model_exchange": ("fmpy",),
    "c_sweep": ("fmpy",),
    "c_environment": ("fmpy",),
    "fmpy_environment": ("fmpy",),
    "fmpy_loop": ("fmpy",),
    "fmpy_model_exchange": ("fmpy",),
    "fmpy_arrays": ("fmpy",),
    "zeromq_lockstep": ("fmpy", "pyzmq"),
    "zenoh_lockstep": ("fmpy", "eclipse-zenoh"),
    "zenoh_round_trip": ("fmpy", "eclipse-zenoh"),
    "helics_federates": ("fmpy", "helics"),
    "ecos_engine": ("ecospy", "tbb"),
    "mosaik_scenario": ("fmpy", "mosaik"),
}


@dataclass(frozen=True)
class Entry:
    """One row of a job's table.

    Attributes:
        label: unique within the job.
        module: of `benchmarks.contestants`.
        points: communication steps of a run.
        quick: the same in a quick run; 0: as many.
        coupling: the algorithm it runs where it is not the job's.
        system: where it is not the job's.
        clock: `summed` for a peer whose time is a running sum of step sizes; its values are compared with such a loop.
        rounds: it takes part in so many rounds; 0: in all.
        beside: label of the row that its ratio refers to; by default the first row of the job.
    """

    label: str
    module: str
    points: int
    quick: int = 0
    options: dict[str, str] = field(default_factory=dict)
    coupling: Algorithm | None = None
    system: System | None = None
    clock: Literal["multiplied", "summed"] = "multiplied"
    rounds: int = 0
    beside: str = ""

    @property
    def packages(self) -> tuple[str, ...]:
        """What has to be installed for it."""
        return _MODULES_NEED.get(self.module, ())

    @property
    def is_ours(self) -> bool:
        """Whether it runs fmu_mesh, of this checkout or of another one."""
        return self.module in (OURS, KINDS, STEPPED, SWEEP)


@dataclass(frozen=True)
class Job:
    """One table.

    Attributes:
        system: has no members where there is nothing to compare the values with.
        timed: the communication steps, or whole commands, from the start of the process to its end.
        watched: whether the first step and the memory of the commands are watched.
        rows: what each row of the table is.
    """

    name: str
    title: str
    system: System
    entries: tuple[Entry, ...]
    timed: Literal["steps", "commands"] = "steps"
    watched: bool = False
    rows: str = "contestant"


def with_checkout(jobs: Sequence[Job], folder: Path) -> list[Job]:
    """The jobs with each of our rows a second time, run by the fmu_mesh of another checkout, if it is a command."""
    found = []
    for job in jobs:
        others = [
            replace(entry, label=entry.label + OTHER, options={**entry.options, "checkout": str(folder.resolve())})
            for entry in job.entries
            if entry.is_ours and entry.module != STEPPED
        ]
        found.append(replace(job, entries=(*job.entries, *others)))
    return found


def _gains(count: int) -> tuple[Member, ...]:
    """An integrator of the constant 1, whose value differs at every point, and gains behind it."""
    source = Member("source", "Integrator", "u", "y", {"u": 1.0, "k": 0.7})
    return (source, *(Member(f"gain_{number}", "Gain", "u", "y", {"k": 1.1}) for number in range(1, count)))


def _starting(count: int) -> System:
    """A chain of integrators that tell when they have done their first step."""
    source = Member("node_0", FMU, "u", "y", {"u": 1.0})
    others = (Member(f"node_{number}", FMU, "u", "y") for number in range(1, count))
    return System("chain", "gauss_seidel", 0.001, (source, *others))


_NOTHING = System("chain", "jacobi", 1.0, ())
_CART = System("chain", "jacobi", 0.02, ())
_PENDULUM = System(
    "chain",
    "gauss_seidel",
    0.002,
    (
        Member("pendulum", "DampedPendulum", "d", "a", {"a": 1.3, "l": 1.0, "d": 0.1}),
        Member("delay", "TransportDelay", "x", "y", {"d": 2.33}),
    ),
)
_CHAIN2 = System("chain", "gauss_seidel", 0.001, _gains(2))
_CHAIN8 = System("chain", "gauss_seidel", 0.001, _gains(8))
_CYCLE2 = System(
    "cycle",
    "jacobi",
    0.001,
    (
        Member("position", "Integrator", "u", "y", {"k": 1.0, "y": 1.0}),
        Member("velocity", "Integrator", "u", "y", {"k": -1.0, "y": 0.0}),
    ),
)
_STAR5 = System("star", "gauss_seidel", 0.001, _gains(5))
_CHATTY = System("chain", "gauss_seidel", 0.001, (Member("chatty", CHATTY, "u", "y", {"u": 1.0}),))
_SIZES = (2, 16, 64)
_US = "fmu_mesh"
_DOPRI5, _C_SOLVER = "fmu_mesh, dopri5", "C, the solver of dopri5"
_BATCH, _C_LOOP = "fmu_mesh, batch()", "C, a loop over copies"
_BATCH_TO_STATE = "reset() of a batch to states"
_OPEN, _RESET_TO_STATE, _RESET_WITH_VALUES = "fmu_mesh, open()", "reset() to a state", "reset() with start values"
_NO_FILE = "fmu_mesh, nothing recorded"
_LOCAL = "fmu_mesh, launch --local"
_FMPY = "FMPy loop, one process"
_C_ONE = "C, one process"
_C_OWN = "C, process per FMU"
_ZENOH = "zenoh lockstep by hand"
_MEMORY = "shared memory, C"
_STREAMS = "fmu_mesh, row streams"
_BY_ZENOH = "fmu_mesh, Zenoh"
_NATIVE, _WINE = "fmu_mesh, native", "fmu_mesh, under Wine"
_APART = "without shared memory, as between two hosts"


def _c(points: int, processes: Literal["one", "own"]) -> Entry:
    return Entry(_C_ONE if processes == "one" else _C_OWN, "c_program", points, options={"processes": processes})


def _fmpy(points: int) -> Entry:
    return Entry(_FMPY, "fmpy_loop", points)


def _arrays(points: int) -> Entry:
    return Entry("FMPy with preallocated arrays, one process", "fmpy_arrays", points)


def _ecos(points: int, processes: Literal["one", "own"], quick: int = 0) -> Entry:
    label = "ecos, one process" if processes == "one" else "ecos, proxyfmu"
    return Entry(label, "ecos_engine", points, quick, {"processes": processes}, "jacobi", clock="summed")


def _helics(label: str, points: int, quick: int, *, core: str = "tcp", coupled: bool = True) -> Entry:
    options = {"core": core, "coupled": "yes" if coupled else "no"}
    return Entry(label, "helics_federates", points, quick, options, "jacobi")


def _messages(points: int, quick: int) -> tuple[Entry, ...]:
    """What exchanges a message for every value."""
    return (
        _helics("HELICS coupled, tcp", points, quick),
        Entry("ZeroMQ lockstep by hand", "zeromq_lockstep", points, quick, coupling="jacobi"),
        Entry(_ZENOH, "zenoh_lockstep", points, quick, coupling="jacobi"),
    )


def _lockstep(points: int, quick: int) -> tuple[Entry, ...]:
    """The same, and mosaik."""
    return (*_messages(points, quick), Entry("mosaik, process per FMU", "mosaik_scenario", points // 2, quick))


def _apart(way: Literal["streams", "zenoh"], points: int, quick: int = 0, **options: str) -> Entry:
    """Ours without shared memory."""
    return Entry(_STREAMS if way == "streams" else _BY_ZENOH, OURS, points, quick, {"apart": way, **options})


def _spinning(transport: Literal["tcp", "unix"], what: Literal["trip", "exchange"]) -> Entry:
    """40 bytes between two processes of C that do not sleep: there and back, or both ways at once."""
    label = f"{'TCP' if transport == 'tcp' else 'Unix socket'}, C, spinning: one {'round ' * (what == 'trip')}{what}"
    options = {"transport": transport, "language": "c", "spins": what, "bytes": "40"}
    return Entry(label, "ping_pong", 50_000, options=options, system=_NOTHING)


def _limit(label: str, transport: str, language: str, cores: str = "any", points: int = 30_000) -> Entry:
    options = {"transport": transport, "language": language, "cores": cores}
    return Entry(label, "ping_pong", points, options=options, system=_NOTHING)


def _starts(count: int) -> tuple[Entry, ...]:
    """The start-up of a chain of so many instances. A peer that starts 64 Pythons takes half a minute."""
    system, rounds = _starting(count), {2: 0, 16: 2, 64: 1}[count]
    own, one = {"processes": "own"}, {"processes": "one"}
    rows = (
        Entry(_US, OURS, POINTS),
        Entry("FMPy script, one process", "fmpy_loop", POINTS),
        Entry("ecos, one process", "ecos_engine", POINTS, options=one, coupling="jacobi", clock="summed"),
        Entry("ecos, proxyfmu", "ecos_engine", POINTS, options=own, coupling="jacobi", clock="summed"),
        replace(_helics("HELICS, tcp", POINTS, 0, coupled=False), rounds=rounds),
        Entry("mosaik, process per FMU", "mosaik_scenario", POINTS, rounds=rounds),
    )
    return tuple(
        replace(row, label=f"{count}: {row.label}", system=system, beside=f"{count}: {rows[0].label}") for row in rows
    )


def _kind(label: str, kind: str, points: int) -> Entry:
    return Entry(label, KINDS, points, points // 4, {"kind": kind}, beside=label)


JOBS = (
    Job(
        "pendulum",
        "pendulum -> delay, 2 ms (configs/pendulum_delay.yaml), own process per FMU",
        _PENDULUM,
        (
            Entry(_US, OURS, 20_000),
            Entry(_LOCAL, OURS, 20_000, options={"local": "yes"}),
            _c(20_000, "own"),
            _c(20_000, "one"),
            _fmpy(20_000),
            _arrays(20_000),
            _ecos(20_000, "one"),
            _ecos(20_000, "own"),
            _helics("HELICS one-way, tcp", 10_000, 4_000, coupled=False),
            _helics("HELICS coupled, zmq", 5_000, 2_000, core="zmq"),
            *_lockstep(10_000, 3_000),
        ),
    ),
    Job(
        "limit",
        "pendulum -> delay, many points: recording, and the limit",
        _PENDULUM,
        (
            Entry(_NO_FILE, OURS, 200_000, options={"record": "none"}),
            Entry("fmu_mesh, two columns to a file", OURS, 200_000),
            Entry("fmu_mesh, all outputs to a file", OURS, 200_000, options={"record": "all"}),
            _c(200_000, "own"),
            _c(200_000, "one"),
        ),
    ),
    Job(
        "chain2",
        "two trivial FMUs in a chain (Integrator -> Gain), own processes",
        _CHAIN2,
        (
            Entry(_US, OURS, 100_000),
            _c(100_000, "own"),
            _c(100_000, "one"),
            _fmpy(100_000),
            _arrays(100_000),
            _ecos(50_000, "one"),
            _ecos(50_000, "own", 20_000),
        ),
    ),
    Job(
        "cycle2",
        "two instances in a cycle (configs/cycle2.yaml), own processes",
        _CYCLE2,
        (
            Entry(_US, OURS, 50_000),
            Entry(_NO_FILE, OURS, 50_000, options={"record": "none"}),
            _c(50_000, "own"),
            _fmpy(50_000),
            _ecos(20_000, "own"),
            *_lockstep(10_000, 3_000),
        ),
    ),
    Job(
        "group",
        "the same cycle in one group",
        _CYCLE2,
        (
            Entry(_US, OURS, 100_000, options={"group": "one"}),
            Entry(_NO_FILE, OURS, 100_000, options={"group": "one", "record": "none"}),
            _c(100_000, "one"),
            _fmpy(100_000),
            _arrays(100_000),
            _ecos(50_000, "one"),
        ),
    ),
    Job(
        "window1",
        "window 1, two nodes in a chain, with the master in a process of its own",
        _CHAIN2,
        (
            Entry("fmu_mesh, gauss_seidel", OURS, 10_000, options={"window": "1"}),
            Entry("fmu_mesh, jacobi", OURS, 10_000, options={"window": "1"}, coupling="jacobi"),
            Entry(f"{_ZENOH}, gauss_seidel", "zenoh_lockstep", 5_000, 3_000),
            Entry(f"{_ZENOH}, jacobi", "zenoh_lockstep", 5_000, 3_000, coupling="jacobi"),
            _limit(f"{_MEMORY}: one round trip", "memory", "c", points=200_000),
        ),
    ),
    Job(
        "windows",
        "two trivial FMUs in a chain: with a library for Windows, under Wine, and their native twins",
        _CHAIN2,
        (
            Entry(_NATIVE, OURS, 100_000),
            Entry(_WINE, OURS, 100_000, options={"windows": "yes"}),
            Entry(f"{_NATIVE}, window 1", OURS, 10_000, options={"window": "1"}),
            Entry(
                f"{_WINE}, window 1",
                OURS,
                10_000,
                options={"window": "1", "windows": "yes"},
                beside=f"{_NATIVE}, window 1",
            ),
            _limit(f"{_MEMORY}: one round trip", "memory", "c", points=200_000),
        ),
    ),
    Job(
        "chain8",
        "chain of 8 against chain of 2, own processes",
        _CHAIN2,
        (
            Entry("fmu_mesh, chain of 2", OURS, 100_000),
            Entry("fmu_mesh, chain of 8", OURS, 100_000, 50_000, system=_CHAIN8),
            replace(_c(100_000, "own"), label="C, chain of 2"),
            replace(_c(100_000, "own"), label="C, chain of 8", system=_CHAIN8),
        ),
    ),
    Job(
        "apart_cycle",
        f"two instances in a cycle (configs/cycle2.yaml) {_APART}",
        _CYCLE2,
        (
            _apart("streams", 50_000),
            Entry(f"{_STREAMS}, nothing recorded", OURS, 50_000, options={"apart": "streams", "record": "none"}),
            _apart("zenoh", 10_000, 3_000),
            *_messages(10_000, 3_000),
            replace(_c(50_000, "own"), label=f"{_C_OWN}, TCP", options={"processes": "own", "transport": "tcp"}),
            _spinning("tcp", "trip"),
            _spinning("tcp", "exchange"),
            _spinning("unix", "trip"),
            _spinning("unix", "exchange"),
            Entry("Zenoh in Python: one round trip", "zenoh_round_trip", 10_000, 3_000, system=_NOTHING),
        ),
    ),
    Job(
        "apart_window1",
        f"window 1, two nodes in a chain, {_APART}",
        _CHAIN2,
        (
            _apart("streams", 10_000, window="1"),
            _apart("zenoh", 5_000, 2_000, window="1"),
            Entry(_ZENOH, "zenoh_lockstep", 5_000, 3_000),
            _spinning("tcp", "trip"),
        ),
    ),
    Job(
        "apart_chain",
        f"pendulum -> delay, many points, with shared memory, and {_APART}",
        _PENDULUM,
        (
            Entry("fmu_mesh, shared memory", OURS, 1_000_000, 400_000),
            _apart("streams", 1_000_000, 400_000),
            _apart("zenoh", 200_000, 50_000),
        ),
    ),
    Job(
        "apart_star",
        f"one source that feeds four, with shared memory, and {_APART}",
        _STAR5,
        (
            Entry("fmu_mesh, shared memory", OURS, 200_000, 100_000),
            _apart("streams", 200_000, 100_000),
        ),
    ),
    Job(
        "kinds",
        "two instances of one kind in a chain, launch --local, nothing recorded",
        _NOTHING,
        (
            _kind("FMI 2.0: Real", "fmi2", 100_000),
            _kind("FMI 1.0: Real, Integer, Boolean", "fmi1", 40_000),
            _kind("FMI 2.0: Real, Integer, Boolean, Enumeration", "fmi2_types", 40_000),
            _kind("FMI 3.0: Float64, Int32, Boolean", "fmi3", 40_000),
            _kind("FMI 2.0, model exchange", "model_exchange", 100_000),
            _kind("component in Python", "component", 100_000),
        ),
    ),
    Job(
        "model_exchange",
        "two oscillators for model exchange in a chain, 1 ms, launch --local, nothing recorded",
        _NOTHING,
        (
            Entry(_DOPRI5, KINDS, 100_000, 20_000, {"kind": "model_exchange_dopri5"}),
            Entry("fmu_mesh, cvode", KINDS, 10_000, 5_000, {"kind": "model_exchange_cvode"}),
            Entry(_C_SOLVER, "c_model_exchange", 100_000, 20_000),
            Entry("FMPy simulate_fmu (CVode), one after the other", "fmpy_model_exchange", 10_000, 5_000),
        ),
    ),
    Job(
        "sweep",
        "a sweep of 2,000 variants of 2,000 points, two workers, no curves, one reduction; a point is a variant",
        _NOTHING,
        (
            Entry("C, two processes, new instances", "c_sweep", 2_000, 500),
            Entry("fmu_mesh, from the call to the table", SWEEP, 2_000, 500),
            Entry("fmu_mesh, while its workers run", SWEEP, 2_000, 500, {"timed": "rows"}),
            Entry("fmu_mesh, instances reset", SWEEP, 2_000, 500, {"reset": "yes"}),
        ),
    ),
    Job(
        "environment",
        "one cart pole (fmus/CartPole.fmu) that a program steps: set, step and get at each point",
        _CART,
        (
            Entry(_OPEN, STEPPED, 200_000, 50_000, {"what": "steps"}),
            Entry(_C_ONE, "c_environment", 1_000_000, 200_000, {"what": "steps"}),
            Entry(_FMPY, "fmpy_environment", 50_000, 20_000, {"what": "steps"}),
        ),
    ),
    Job(
        "batch",
        "1,024 such cart poles as arrays: set, step and four outputs of each copy at each point",
        _CART,
        (
            Entry(_BATCH, STEPPED, 1_024_000, 204_800, {"what": "batch", "copies": "1024"}),
            Entry(
                f"{_BATCH}, two threads",
                STEPPED,
                1_024_000,
                204_800,
                {"what": "batch", "copies": "1024", "threads": "2"},
            ),
            Entry(
                f"{_BATCH}, two processes",
                STEPPED,
                1_024_000,
                204_800,
                {"what": "batch", "copies": "1024", "processes": "2"},
            ),
            Entry(_C_LOOP, "c_environment", 1_024_000, 204_800, {"what": "batch", "copies": "1024"}),
            Entry("FMPy loop over 64", "fmpy_environment", 25_600, 12_800, {"what": "batch", "copies": "64"}),
        ),
    ),
    Job(
        "resets",
        "the same cart pole: one way back to its first point, and get",
        _CART,
        (
            Entry(_RESET_TO_STATE, STEPPED, 100_000, 20_000, {"what": "state"}),
            Entry(_BATCH_TO_STATE, STEPPED, 1_024_000, 204_800, {"what": "batch_state", "copies": "1024"}),
            Entry("C: fmi2SetFMUstate", "c_environment", 10_000_000, 1_000_000, {"what": "state", "copies": "1024"}),
            Entry(_RESET_WITH_VALUES, STEPPED, 2_000, 500, {"what": "values"}),
            Entry("C: fmi2Reset and initialization", "c_environment", 10_000_000, 1_000_000, {"what": "values"}),
            Entry("FMPy: reset and initialization", "fmpy_environment", 10_000, 5_000, {"what": "values"}),
            Entry("a new open()", STEPPED, 50, 20, {"what": "open"}),
        ),
    ),
    Job(
        "chatty",
        "an FMU that logs 20 messages at every step",
        _CHATTY,
        (
            Entry(_US, OURS, 20_000),
            Entry(_LOCAL, OURS, 20_000, options={"local": "yes"}),
            Entry("FMPy loop whose logger appends to a list", "fmpy_loop", 20_000, beside=_US),
        ),
    ),
    Job(
        "command",
        "pendulum -> delay: the whole command, from its start to its end",
        _PENDULUM,
        (
            Entry("fmu-mesh launch", OURS, 20_000),
            Entry("fmu-mesh launch --local", OURS, 20_000, options={"local": "yes"}),
            Entry("FMPy script, one process, no file", "fmpy_loop", 20_000),
            replace(_ecos(20_000, "one"), label="ecos, one process, no file"),
        ),
        timed="commands",
    ),
    Job(
        "startup",
        "start-up: a chain of 2, 16 and 64 integrators, 10 points",
        _starting(2),
        tuple(entry for count in _SIZES for entry in _starts(count)),
        timed="commands",
        watched=True,
    ),
    Job(
        "limits",
        "physical limits: one round trip of 16 bytes between two processes",
        _NOTHING,
        (
            _limit(_MEMORY, "memory", "c", points=200_000),
            _limit("Unix socket, C", "unix", "c"),
            _limit("Unix socket, C, both on one core", "unix", "c", "one"),
            _limit("TCP loopback, C", "tcp", "c"),
            _limit("Unix socket, Python", "unix", "python"),
            _limit("TCP loopback, Python", "tcp", "python"),
        ),
    ),
)
