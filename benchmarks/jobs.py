"""The jobs: which system, which contestants, how many points, and what the ratios should be."""

from __future__ import annotations

from dataclasses import dataclass, field, replace

from benchmarks.task import Algorithm, Member, System

__all__ = ["JOBS", "OURS", "Entry", "Job", "Target"]

OURS = "fmu_mesh_launch"
_MODULES_NEED = {
    "fmpy_loop": ("fmpy",),
    "fmpy_arrays": ("fmpy",),
    "zeromq_lockstep": ("fmpy", "pyzmq"),
    "zenoh_lockstep": ("fmpy", "eclipse-zenoh"),
    "helics_federates": ("fmpy", "helics"),
    "ecos_proxyfmu": ("ecospy", "tbb"),
    "mosaik_scenario": ("fmpy", "mosaik"),
}


@dataclass(frozen=True)
class Entry:
    """One row of a job's table.

    Attributes:
        label: unique within the job.
        module: of `benchmarks.contestants`.
        points: communication steps of a full run; a quick one takes `quick`.
        clock: `summed` for a peer whose time is a running sum of step sizes; its values are compared with such a loop.
        coupling: the algorithm it runs where it is not the job's.
        system: where it is not the job's.
    """

    label: str
    module: str
    points: int
    quick: int
    options: dict[str, str] = field(default_factory=dict)
    coupling: Algorithm | None = None
    system: System | None = None
    clock: str = "multiplied"

    @property
    def packages(self) -> tuple[str, ...]:
        """What has to be installed for it."""
        return _MODULES_NEED.get(self.module, ())


@dataclass(frozen=True)
class Target:
    """What issue 3 asks for.

    The ratio is that of the costs (seconds per point and instance): of `against` over `entry` for a speed-up, which
    should be at least `required`; of `entry` over `against` for an overhead, which should be at most that.
    """

    entry: str
    against: str
    required: float
    aim: float
    overhead: bool = False

    def meets(self, ratio: float) -> bool:
        """Whether a ratio is what is required."""
        return ratio <= self.required if self.overhead else ratio >= self.required


@dataclass(frozen=True)
class Job:
    """One table. The first entry is what the others' ratios refer to."""

    name: str
    title: str
    system: System | None
    entries: tuple[Entry, ...]
    targets: tuple[Target, ...] = ()


def _gains(count: int) -> tuple[Member, ...]:
    """An integrator of the constant 1, whose value differs at every point, and gains behind it."""
    source = Member("source", "Integrator", "u", "y", {"u": 1.0, "k": 0.7})
    return (source, *(Member(f"gain_{number}", "Gain", "u", "y", {"k": 1.1}) for number in range(1, count)))


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
_FMPY = "FMPy loop, one process"
_ARRAYS = "FMPy with preallocated arrays, one process"
_ECOS = "ecos, proxyfmu"
_ZEROMQ = "ZeroMQ lockstep by hand"
_ZENOH = "zenoh lockstep by hand"
_MOSAIK = "mosaik, process per FMU"
_HELICS = "HELICS coupled, tcp"


def _helics(label: str, points: int, quick: int, *, core: str = "tcp", coupled: bool = True) -> Entry:
    options = {"core": core, "coupled": "yes" if coupled else "no"}
    return Entry(label, "helics_federates", points, quick, options, "jacobi")


def _limit(label: str, transport: str, language: str, cores: str = "any") -> Entry:
    options = {"transport": transport, "language": language, "cores": cores}
    return Entry(label, "ping_pong", 100_000, 30_000, options)


def _recording(name: str, what: str, system: System, **options: str) -> Job:
    recorded, plain = "fmu_mesh, all outputs to a file", "fmu_mesh, nothing recorded"
    return Job(
        name,
        f"{what}: recording all outputs against recording none",
        system,
        (
            Entry(recorded, OURS, 100_000, 40_000, {**options, "record": "all"}),
            Entry(plain, OURS, 100_000, 40_000, {**options, "record": "none"}),
        ),
        (Target(recorded, plain, 1.3, 1.05, overhead=True),),
    )


JOBS = (
    Job(
        "pendulum",
        "pendulum -> delay, 2 ms (configs/pendulum_delay.yaml), own process per FMU",
        _PENDULUM,
        (
            Entry("fmu_mesh", OURS, 20_000, 20_000),
            Entry(_FMPY, "fmpy_loop", 20_000, 20_000),
            Entry(_ARRAYS, "fmpy_arrays", 20_000, 20_000),
            Entry(_ECOS, "ecos_proxyfmu", 20_000, 20_000, coupling="jacobi", clock="summed"),
            _helics("HELICS one-way, tcp", 20_000, 4_000, coupled=False),
            _helics(_HELICS, 20_000, 4_000),
            _helics("HELICS coupled, zmq", 20_000, 2_000, core="zmq"),
            Entry(_ZEROMQ, "zeromq_lockstep", 20_000, 5_000, coupling="jacobi"),
            Entry(_ZENOH, "zenoh_lockstep", 20_000, 5_000, coupling="jacobi"),
            Entry(_MOSAIK, "mosaik_scenario", 20_000, 2_000),
        ),
        (
            Target("fmu_mesh", _FMPY, 1.3, 1.8),
            Target("fmu_mesh", _ECOS, 1.5, 3.0),
            Target("fmu_mesh", _HELICS, 8.0, 15.0),
            Target("fmu_mesh", _ZENOH, 8.0, 15.0),
        ),
    ),
    Job(
        "chain2",
        "two trivial FMUs in a chain (Integrator -> Gain), own processes",
        _CHAIN2,
        (
            Entry("fmu_mesh", OURS, 100_000, 50_000),
            Entry(_FMPY, "fmpy_loop", 100_000, 50_000),
            Entry(_ARRAYS, "fmpy_arrays", 100_000, 50_000),
            Entry(_ECOS, "ecos_proxyfmu", 100_000, 20_000, coupling="jacobi", clock="summed"),
        ),
        (Target("fmu_mesh", _FMPY, 1.2, 2.0),),
    ),
    Job(
        "cycle2",
        "two instances in a cycle (configs/cycle2.yaml), own processes",
        _CYCLE2,
        (
            Entry("fmu_mesh", OURS, 20_000, 10_000),
            Entry(_FMPY, "fmpy_loop", 20_000, 20_000),
            Entry(_ECOS, "ecos_proxyfmu", 20_000, 20_000, clock="summed"),
            _helics(_HELICS, 20_000, 4_000),
            Entry(_ZEROMQ, "zeromq_lockstep", 20_000, 5_000),
            Entry(_ZENOH, "zenoh_lockstep", 20_000, 5_000),
            Entry(_MOSAIK, "mosaik_scenario", 20_000, 2_000),
        ),
        (Target("fmu_mesh", _HELICS, 3.0, 5.0),),
    ),
    Job(
        "group",
        "the same cycle in one group",
        _CYCLE2,
        (
            Entry("fmu_mesh", OURS, 100_000, 50_000, {"group": "one"}),
            Entry(_FMPY, "fmpy_loop", 100_000, 50_000),
            Entry(_ARRAYS, "fmpy_arrays", 100_000, 50_000),
        ),
        (Target("fmu_mesh", _FMPY, 1.5, 3.0),),
    ),
    Job(
        "window1",
        "window 1, two nodes in a chain",
        _CHAIN2,
        (
            Entry("fmu_mesh, jacobi", OURS, 10_000, 4_000, {"window": "1"}, "jacobi"),
            Entry(f"{_ZENOH}, jacobi", "zenoh_lockstep", 10_000, 4_000, coupling="jacobi"),
            Entry("fmu_mesh, gauss_seidel", OURS, 10_000, 4_000, {"window": "1"}),
            Entry(f"{_ZENOH}, gauss_seidel", "zenoh_lockstep", 10_000, 4_000),
        ),
        (
            Target("fmu_mesh, jacobi", f"{_ZENOH}, jacobi", 1.0, 1.3),
            Target("fmu_mesh, gauss_seidel", f"{_ZENOH}, gauss_seidel", 1.0, 1.3),
        ),
    ),
    Job(
        "chain8",
        "chain of 8 against chain of 2: cost per point and instance, own processes",
        _CHAIN2,
        (
            Entry("fmu_mesh, chain of 2", OURS, 100_000, 50_000),
            Entry("fmu_mesh, chain of 8", OURS, 50_000, 20_000, system=_CHAIN8),
        ),
        (Target("fmu_mesh, chain of 8", "fmu_mesh, chain of 2", 1.5, 1.0, overhead=True),),
    ),
    _recording("record", "pendulum -> delay", replace(_PENDULUM, step_size=0.001)),
    _recording("record_group", "the cycle in one group", _CYCLE2, group="one"),
    Job(
        "limits",
        "physical limits: one round trip of 16 bytes between two processes",
        None,
        (
            _limit("Unix socket, C", "unix", "c"),
            _limit("Unix socket, C, both on one core", "unix", "c", "one"),
            _limit("TCP loopback, C", "tcp", "c"),
            _limit("Unix socket, Python", "unix", "python"),
            _limit("TCP loopback, Python", "tcp", "python"),
        ),
    ),
)
