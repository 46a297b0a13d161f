"""A state of a system as a file: a head that says of which mesh it is, and the state of each instance.

The file begins with eight letters, the version of this format, the length of the head and its SHA-256; the head has the
size and the SHA-256 of each block that follows. So a file that was cut or changed anywhere is refused before any of it
reaches a model. It is no signature: who can write the file chooses what the models get (ADR 88).
"""

# With a directory for `--resume`, one thread gives the checkpoints of a run to the disk; the master's only hands them
# over, so it never waits for a disk. The thread that gives rows to the disk removes old ones (ADR 91): a file that is
# gone meanwhile is no error.

from __future__ import annotations

import hashlib
import os
import struct
from collections.abc import Callable, Iterable, Mapping, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import suppress
from pathlib import Path
from types import MappingProxyType
from typing import Final, NamedTuple, Self

import msgspec
from msgspec.structs import replace

from .. import __version__, files
from ..errors import CallRefused, ConfigurationError, Finding
from ..files import Kept
from ..results.played_rows import PLAYED_ROWS, PlayedRows, rows_to_play
from ..system.plan import RECORDER, Plan, make_plan
from ..system.played_nodes import stateless
from ..system.series_files import courses_of
from ..system.states import BeginsWith, SavedInstance, differences, saved_instances
from ..text import nearest, option_text, short_number
from ..variables.value_conversion import to_plain
from ..variables.value_types import PlainValue
from .options import BeginOptions
from .run_plan import RunPlan

__all__ = [
    "STATE",
    "StateFile",
    "again_from_checkpoint",
    "drop_older",
    "keeper",
    "state_bytes",
    "with_replaced",
    "write_state",
]

STATE: Final = ".state"
"""How the names of checkpoints in the folder of a run end."""

_LETTERS = b"FMUSTATE"
_VERSION = 1
_START = struct.Struct("<8sIQ32s")  # letters, version, length of the head, its SHA-256


class _Head(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """The head: times in s; of each block, in their order, its instance, and its size in bytes and its SHA-256."""

    fmu_mesh: str
    mesh: str
    point: int
    start_time: float
    step_size: float
    instances: dict[str, SavedInstance]
    blocks: dict[str, tuple[int, bytes]]


class StateFile(NamedTuple):
    """A state that was read from a file; ``states`` has that of each instance, as `LocalMember.packed` makes it."""

    file: Path
    head: _Head
    states: Mapping[str, bytes]

    @classmethod
    def of(cls, options: BeginOptions) -> Self | None:
        """The state with which a run begins, if its options name one; errors as of `read`.

        Raises:
            CallRefused: instances are replaced without a state.
        """
        if options.state is None and options.replaced:
            raise CallRefused(
                f"{option_text('replaced', options.replaced)} needs a state", hint="Give it by `state=...`."
            )
        return cls.read(Path(options.state)) if options.state is not None else None

    @classmethod
    def read(cls, file: Path) -> Self:
        """Read a file, and check that it is complete and unchanged.

        Raises:
            ConfigurationError: it cannot be read, is no state, has another version of the format, or was changed.
        """
        try:
            with files.opened(file) as source:
                data = memoryview(source.read())
        except OSError as error:
            raise ConfigurationError(f"the state '{file}' cannot be read: {error.strerror}") from error
        if data[: len(_LETTERS)] != _LETTERS:
            raise ConfigurationError(f"'{file}' is no state: `System.save` writes such files")
        damaged = ConfigurationError(
            f"the state '{file}' is damaged: it was cut or changed after it was written", hint="Use another state."
        )
        if len(data) < _START.size:
            raise damaged
        _, version, length, sha256 = _START.unpack(data[: _START.size])
        if version != _VERSION:
            text = f"the state '{file}' has version {version} of its format, and this fmu_mesh reads {_VERSION}"
            raise ConfigurationError(text, hint="Write it again with this version of fmu_mesh.")
        head, rest = data[_START.size :][:length], data[_START.size :][length:]
        if hashlib.sha256(head).digest() != sha256:
            raise damaged
        try:
            known = msgspec.msgpack.decode(head, type=_Head)
        except (msgspec.MsgspecError, ValueError, RecursionError) as error:
            raise damaged from error
        states = {}
        for name, (size, expected) in known.blocks.items():
            states[name], rest = bytes(rest[:size]), rest[size:]
            if hashlib.sha256(states[name]).digest() != expected:
                raise damaged
        if rest or states.keys() != known.instances.keys():
            raise damaged
        return cls(file, known, states)

    def check(self, run: RunPlan) -> BeginsWith:
        """Check that a run can go on from here; returns the states, and what is set besides.

        Raises:
            ConfigurationError: what must agree does not; carries all differences.
        """
        grid, head, findings, system = run.plan.grid, self.head, list[Finding](), run.plan.system
        for what in ("start_time", "step_size"):
            if (was := getattr(head, what)) != (now := getattr(grid, what)):
                text = f"was {short_number(was)} s where the state was written, and is {short_number(now)} s"
                findings.append(Finding(str(self.file), f"simulation.{what}", text, ""))
        if (stop := grid.stop_time) is not None and grid.last_point < head.point:
            text = f"{short_number(stop)} s, and the state is of {short_number(grid.time(head.point))} s"
            findings.append(Finding(str(self.file), "simulation.stop_time", text, "a later time"))
        refused, values = differences(head.instances, run.plan, run.contents)
        findings += [Finding(str(self.file), f"instances.{name}", why, "") for name, why in refused]
        if findings:
            text = f"the state '{self.file}' is not one of this mesh"
            hint = "Open the mesh as it was when the state was written; tunable parameters and free inputs may differ."
            if other := next((name for name, why in refused if why.startswith("model: ")), None):
                option = option_text("replaced", [other])
                hint += f" With {option}, an instance with another model of the same interface begins anew there."
            raise ConfigurationError(text, findings=tuple(findings), hint=hint)
        if system.replaced:
            self._check_point(run, {})
        anew = {name: _prescribed(run, name, head.point) for name in system.replaced}
        return BeginsWith({name: own for name, own in self.states.items() if name not in anew}, values, anew)

    def _check_point(self, run: RunPlan, lost: Mapping[str, str]) -> None:
        """Check that each instance has a point of its own here, and that none has ``lost`` its state; by name, why."""
        instances, point = run.plan.system.instances, self.head.point
        whys = [
            (name, f"its step is {own.step_points} points, and the state is of point {point}, within one")
            for name, own in instances.items()
            if point % own.step_points
        ]
        whys += [(name, f"its state cannot be restored: {why}") for name, why in lost.items()]
        if whys:
            findings = tuple(Finding(str(self.file), f"instances.{name}", why, "") for name, why in whys)
            raise ConfigurationError(f"a run cannot begin with the state '{self.file}'", findings=findings)

    def begin(self, run: RunPlan, replaced: Iterable[str] = ()) -> RunPlan:
        """The plan of a run that begins here: this point is its first one, and times are as they are.

        The ``replaced`` instances begin anew: see `with_replaced`.

        Raises:
            ConfigurationError: it cannot begin here; carries all differences.
        """
        run = with_replaced(run, replaced)
        begins_with, plan, point = self.check(run), run.plan, self.head.point
        lost = {name: why for name, why in stateless(plan.system).items() if name not in begins_with.anew}
        self._check_point(run, lost)
        grid = replace(plan.grid, first_point=point)
        records = tuple(replace(own, first=own.point_of(own.rows_before(point))) for own in plan.system.records)
        system = replace(plan.system, grid=grid, records=records, begins_with=str(self.file.absolute()))
        nodes = {
            name: replace(node, grid=grid, records=records if name == RECORDER else ())
            for name, node in plan.nodes.items()
        }
        return replace(run, plan=replace(plan, system=system, nodes=nodes), begins_with=begins_with)


def with_replaced(run: RunPlan, names: Iterable[str]) -> RunPlan:
    """The plan of a run with a state in which these instances begin anew: Initialization Mode is another one.

    Raises:
        ConfigurationError: there is no such instance.
    """
    if not (replaced := tuple(dict.fromkeys(names))):
        return run
    for name in replaced:
        if name not in (known := run.plan.system.instances):
            near = nearest(name, known)
            text = f"{option_text('replaced', [name])}: mesh '{run.mesh}' has no such instance"
            raise ConfigurationError(text, hint=f"Did you mean '{near}'?" if near else None)
    return replace(run, plan=make_plan(replace(run.plan.system, replaced=replaced), contents=run.contents))


def _prescribed(run: RunPlan, name: str, point: int) -> dict[str, PlainValue]:
    """What a scenario has set of an instance by this point."""
    own, grid = run.plan.system.instances[name], run.plan.grid
    courses = courses_of(own.scenario, own.description, grid, own.step_points)
    values = {variable: course.value(point // own.step_points) for variable, course in courses.items()}
    return {variable: to_plain(value) for variable, value in values.items() if value is not None}


def state_bytes(
    run: RunPlan,
    point: int,
    states: Mapping[str, bytes],
    others: Mapping[str, Mapping[str, PlainValue]] = MappingProxyType({}),
) -> bytes:
    """The content of a state file: the states of a run at a point; see `StateFile`.

    ``others`` are the start values that are not as in the plan, by instance and variable.
    """
    grid = run.plan.grid
    blocks = {name: (len(own), hashlib.sha256(own).digest()) for name, own in states.items()}
    instances = {name: own for name, own in saved_instances(run.plan, run.contents, others).items() if name in states}
    own = _Head(__version__, run.mesh, point, grid.start_time, grid.step_size, instances, blocks)
    head = msgspec.msgpack.encode(own)
    start = _START.pack(_LETTERS, _VERSION, len(head), hashlib.sha256(head).digest())
    return b"".join((start, head, *states.values()))


def keeper(run: RunPlan, played: PlayedRows | None) -> Callable[[int, bytes], None]:
    """A function that keeps the checkpoint at a point for a restart of a run; `drop_older` removes those before.

    With a directory it gives them to the disk, on a thread of its own; a checkpoint that comes meanwhile is left out.
    The errors are those of `write_state`; with a directory, they are of the checkpoint before. After a checkpoint,
    nodes may have to have ``played`` their rows: if these cannot be written, that is an error, too.
    """
    folder, worker, last = run.kept_in, ThreadPoolExecutor(1, thread_name_prefix="checkpoints"), list[Future[None]]()

    def keep(point: int, data: bytes) -> None:
        file = folder / f"{point}{STATE}"
        if played is not None and played.error:
            raise ConfigurationError(played.error)
        if not run.directory:
            write_state(file, data, synced=False)
            if not run.plan.system.records and played is None:  # nobody writes rows
                drop_older(folder, run.plan, (), 0)
        elif not last or last[-1].done():
            if last:
                last.pop().result()
            last.append(worker.submit(write_state, file, data))

    return keep


def drop_older(folder: Path, plan: Plan, kept: Sequence[Kept], played: int) -> None:
    """Remove the checkpoints before the newest one of which the files have all rows before it.

    ``kept`` is what they have, and the ``played`` points are those of which rows can be played. How far files are
    behind the steps is up to the disk, so there may be any number of newer checkpoints that cannot be used yet.
    """
    states = iter(_newest_first(folder))
    for file in states:
        if _has_rows(_point_of(file), plan, [own.rows for own in kept], played):
            break
    for file in states:
        file.unlink(missing_ok=True)


def _has_rows(point: int, plan: Plan, rows: Sequence[int], played: int) -> bool:
    records = zip(rows, plan.system.records, strict=True)
    return all(there >= own.rows_before(point) for there, own in records) and (not plan.played or 0 < point <= played)


def _newest_first(folder: Path) -> list[Path]:
    """The checkpoints in a folder, without those that are being written."""
    return sorted((own for own in folder.glob(f"*{STATE}") if own.stem.isdecimal()), key=_point_of, reverse=True)


def again_from_checkpoint(run: RunPlan, folder: Path, rows: Sequence[int]) -> RunPlan:
    """A run that starts again, from its newest checkpoint of which all files have the ``rows`` before it.

    Without one, it begins where it began. Where instances have no state, it does that, too, and others play their rows.
    """
    system, played = run.plan.system, rows_to_play(folder / PLAYED_ROWS)
    for file in _newest_first(folder):
        with suppress(ConfigurationError):  # its writer was killed
            state = StateFile.read(file)
            point = state.head.point
            if not _has_rows(point, run.plan, rows, played):
                continue
            if run.plan.played:
                seen = max(run.replays_to, point)
                return replace(run, begins_with=BeginsWith(dict(state.states)), plays_to=point, replays_to=seen)
            grid = replace(run.plan.grid, first_point=point)
            nodes = {name: replace(node, grid=grid) for name, node in run.plan.nodes.items()}
            plan = replace(run.plan, system=replace(system, grid=grid), nodes=nodes)
            return replace(run, plan=plan, begins_with=BeginsWith(dict(state.states)))
    return run


def _point_of(file: Path) -> int:
    return int(file.stem)


def write_state(file: Path, data: bytes, *, synced: bool = True) -> None:
    """Write the content of a state file, in the place of an older one; if ``synced``, it survives a power cut.

    Raises:
        ConfigurationError: the file cannot be written; an older one is as it was.
    """
    try:
        with files.replaced(file) as draft, draft.open("wb") as target:
            target.write(data)
            target.flush()
            if synced:  # else its name could survive a power cut, and its content not
                os.fsync(target.fileno())
    except OSError as error:
        raise ConfigurationError(f"the state '{file}' cannot be written: {error.strerror}") from error
