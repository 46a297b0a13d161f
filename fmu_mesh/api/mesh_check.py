"""What a check of a mesh has found: the plan of its run, or everything that is wrong."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path

import msgspec
from msgspec.structs import replace

from ..errors import ConfigurationError, Finding
from ..instances.registry import check_engines
from ..pictures.plan_page import plan_page
from ..pictures.plan_view import PlanView, plan_view
from ..pictures.tables import html_table
from ..printing import page
from ..run.run_plan import RunPlan
from ..ssp.configuration_files import names_world
from ..ssp.naming import WORLD
from ..system.round_trip import round_trip_cost
from ..text import counted, listed

__all__ = ["AccessView", "Check", "check_of", "together"]


class AccessView(msgspec.Struct, frozen=True):
    """Who reaches a mesh beyond its user, and what they may do. Whoever comes by its sockets may do everything.

    Attributes:
        shared_with: the group of this host whose members come by a socket.
        name: of the certificate with which the mesh comes to others; empty without `security`, as are those below.
        authority: who has signed it.
        until: its end, in ISO 8601.
        table: number of the table of roles; 0: no authority of ours has made it.
        roles: the names by their role; none where the mesh listens nowhere.
    """

    listen: tuple[str, ...]
    connect: tuple[str, ...]
    shared_with: str | None = None
    name: str = ""
    authority: str = ""
    until: str = ""
    table: int = 0
    roles: dict[str, tuple[str, ...]] = {}

    @property
    def lines(self) -> list[str]:
        """In words."""
        lines = [f"listens at {listed(self.listen)}"] if self.listen else []
        lines += [f"connects to {listed(self.connect)}"] if self.connect else []
        lines += [f"members of the group '{self.shared_with}' may do what you may"] if self.shared_with else []
        lines += (
            [f"certificate of '{self.name}', signed by '{self.authority}', until {self.until}"] if self.name else []
        )
        lines += [f"table {self.table} of roles"] if self.table else []
        lines += [f"{role}: {listed(names)}" for role, names in self.roles.items()]
        return ["", "Access", *(f"  {line}" for line in lines)]


class Check(msgspec.Struct, frozen=True):
    """What `Mesh.check` found. As text, it is the page that `fmu-mesh check` prints.

    Example:
        >>> import fmu_mesh
        >>> check = fmu_mesh.load("configs/pendulum_delay.yaml").check()
        >>> bool(check), check.findings
        (True, ())
        >>> check.plan.order, check.plan.last_point
        (['pendulum', 'delay'], 20000)
        >>> print(check)
        Mesh        pendulum_delay
        Simulation  0 s to 40 s in 20000 steps of 0.002 s
        ...
        OK: configs/pendulum_delay.yaml can run.

    Attributes:
        file: the configuration, as messages name it.
        error: why the mesh cannot run; None if it can.
        run: the plan of the run; None if the configuration is wrong. It is there if only this host lacks something.
        access: who may do what; None if only its user reaches it, or everybody (`warnings`), or if it cannot be used.
    """

    file: str
    error: ConfigurationError | None = None
    run: RunPlan | None = None
    access: AccessView | None = None

    @property
    def findings(self) -> tuple[Finding, ...]:
        """Everything that is wrong, each with its place; empty if the mesh can run."""
        if self.error is None:
            return ()
        return self.error.findings or (Finding(self.file, "", self.error.message, self.error.hint or ""),)

    @property
    def warnings(self) -> tuple[str, ...]:
        """What may be wrong, in words."""
        return tuple(map(str, self.run.plan.system.warnings)) if self.run is not None else ()

    @property
    def plan(self) -> PlanView | None:
        """What would run, as plain values; None if the configuration is wrong."""
        return plan_view(self.run.plan, self.run.loaded) if self.run is not None else None

    @property
    def page(self) -> str:
        """What would run, as text; empty if the configuration is wrong."""
        access = self.access.lines if self.access is not None else ()
        return page([*plan_page(self.run.plan, self.run.loaded), *access]) if self.run is not None else ""

    def at_round_trip(self, seconds: float) -> list[str]:
        """What a network with this round trip between hosts costs the run at least, in sentences.

        Example:
            >>> import fmu_mesh
            >>> fmu_mesh.load("configs/pendulum_delay.yaml").check(window=1).at_round_trip(0.05)
            ['window 1: between hosts at least 0.05 s per point, 1000 s for 20000 points']
        """
        return round_trip_cost(self.require().plan, seconds)

    def require(self) -> RunPlan:
        """The plan of the run.

        Raises:
            ConfigurationError: the mesh cannot run; carries all findings.
        """
        if self.error is not None:
            raise self.error
        assert self.run is not None
        return self.run

    def __repr__(self) -> str:
        verdict = "can run" if self else counted(len(self.findings), "finding")
        return f"<Check of {self.file}: {verdict}, {counted(len(self.warnings), 'warning')}>"

    def _repr_html_(self) -> str:
        told = [*self.findings, *(self.run.plan.system.warnings if self.run is not None else ())]
        title = f"OK: {self.file} can run." if self else f"{self.file} cannot run."
        if told:
            cells = ((one.path or one.file, one.found, one.expected, one.suggestion) for one in told)
            return html_table(title, ["place", "found", "expected", "did you mean"], cells, len(told))
        instances = self.require().plan.system.instances
        rows = ((own.name, Path(own.fmu).name, own.node) for own in instances.values())
        return html_table(title, ["instance", "model", "process"], rows, len(instances))

    def __bool__(self) -> bool:
        return self.error is None

    def __str__(self) -> str:
        verdict = "\n".join(map(str, self.findings)) or f"OK: {self.file} can run."
        return f"{self.page}\n\n{verdict}" if self.run is not None else verdict


def check_of(file: str, plan: Callable[[], RunPlan]) -> Check:
    """Check what ``plan`` makes of the file, and that this host has what the run needs."""
    run, errors, access = None, [], None
    try:
        run = plan()
    except ConfigurationError as error:
        run, errors = error.plan, [error]
    if run is not None:
        system, findings = run.plan.system, run.loaded.findings()
        models = {name: (Path(one.fmu), one.description) for name, one in system.instances.items()}
        # Of a world, only the SDF is checked: that the engine is missing is a warning there.
        of_file = names_world(run.loaded.file)
        instances = {name: one for name, one in system.config.instances.items() if not of_file or name != WORLD}
        check_engines(instances, models, system.config.limits, findings)
        for look in (findings.raise_any, run.check_memory):
            try:
                look()
            except ConfigurationError as error:
                errors.append(error)
        try:
            access = _access(run)
        except ConfigurationError as error:
            errors.append(error)
    return Check(file, together(file, errors) if errors else None, run, access)


def _access(run: RunPlan) -> AccessView | None:
    """Who may do what with a run.

    Raises:
        ConfigurationError: its certificate cannot be used.
    """
    config = run.loaded.config
    if config.security is None and config.runtime.share_with is None:
        return None
    from ..run.wiring import identity_of  # noqa: PLC0415  a check needs no Zenoh

    view = AccessView(tuple(config.zenoh.listen), tuple(config.zenoh.connect), config.runtime.share_with)
    if (own := identity_of(run)) is None:
        return view
    table = own.table.roles if own.table is not None else {}
    roles = {role: tuple(name for name, its in table.items() if its == role) for role in sorted({*table.values()})}
    until, number = own.until.isoformat(timespec="minutes"), own.table.number if own.table is not None else 0
    return replace(view, name=own.name, authority=own.authority, until=until, table=number, roles=roles)


def together(file: str, errors: Sequence[ConfigurationError]) -> ConfigurationError:
    """One error with the findings of several, of which there is at least one."""
    if len(errors) == 1:
        return errors[0]
    findings = tuple(finding for error in errors for finding in Check(file, error).findings)
    return ConfigurationError(f"{file}: {len(findings)} problems", findings=findings)
