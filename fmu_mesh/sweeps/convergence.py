"""`Convergence`: a mesh with the step sizes h, h/2, h/4, ..., and what the differences of its runs say of its error.

The runs are variants of a sweep. A variable is judged by the order that it shows at the points of all runs (ADR 94).
"""

from __future__ import annotations

import csv
import io
import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from functools import partial
from itertools import pairwise
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING, Any, Final

import msgspec
import numpy as np
from numpy.typing import NDArray

from ..api.mesh_builder import Mesh
from ..api.result import recorded_variables
from ..config.call_options import checked
from ..errors import CallRefused, ConfigurationError, FmuError, FmuMeshError, Interrupted, MeshLost
from ..files import write_whole
from ..pictures.sweep_drawing import convergence_figure
from ..pictures.tables import html_table, table
from ..printing import page
from ..results.recording import Columns
from ..run.options import ConvergenceOptions, VariantOptions
from ..run.run_plan import RunPlan
from ..text import counted, listed, short_number
from ..variables.value_types import is_float
from .sweeping import Sweep, sweep
from .variant_run import options_of_variant

if TYPE_CHECKING:
    from matplotlib.figure import Figure

__all__ = ["Convergence", "converging"]

_LEAST, _LARGEST, _APART = 0.8, 4.5, 0.5
"""Between which ends an order is plausible, and how far orders may be apart that are one order."""
_SAME: Final = "no difference beyond rounding between the two finest runs"
_STEP: Final = "simulation.step_size"
_HEADING: Final = ("variable", "order", "order (RMS)", "estimated error", "relative", "")


class VariableConvergence(msgspec.Struct, frozen=True):
    """How one variable converges.

    Attributes:
        name: `instance.variable`; ``unit``: its unit, None without one.
        verdict: `converges`, or in words why there is no order and no error.
        order: by the largest difference at the common points; ``rms_order``: by the root mean square.
        error: the largest error of the finest run at these points, estimated by Richardson, in the unit.
        largest: the largest absolute value of the finest run.
        differences: the largest difference between each run and the next finer one.
    """

    name: str
    unit: str | None
    verdict: str
    order: float | None
    rms_order: float | None
    error: float | None
    largest: float
    differences: tuple[float, ...]


class Convergence(msgspec.Struct, frozen=True):
    """What `Mesh.convergence` has found. As text, it is what `fmu-mesh convergence` prints.

    Example:
        >>> import fmu_mesh
        >>> found = fmu_mesh.load("configs/cycle2.yaml").convergence(stop_time=1.0)
        >>> found.step_sizes, found.steps, found.points
        ((0.001, 0.0005, 0.00025), (2000, 4000, 8000), 1001)

    Attributes:
        step_sizes: that of each run in s, the largest first; ``steps``: the steps of all its instances together.
        points: number of points that all runs have recorded; only these are compared.
        variables: the recorded continuous variables; ``not_compared``: why others are not compared, by name.
        warnings: what the runs warn of.
    """

    mesh: str
    step_sizes: tuple[float, ...]
    steps: tuple[int, ...]
    points: int
    variables: tuple[VariableConvergence, ...]
    not_compared: dict[str, str]
    warnings: tuple[str, ...] = ()

    @staticmethod
    def of(mesh: Mesh, options: ConvergenceOptions) -> Convergence:
        """As `Mesh.convergence`."""
        with converging(mesh, options) as (runs, found):
            runs.wait()
            return found()

    def __str__(self) -> str:
        lines = [f"{self._head}, compared at {counted(self.points, 'common point')}", ""]
        lines += table(self._cells(), heading=_HEADING) or ["no continuous variable"]
        if others := [f"{name} ({why})" for name, why in self.not_compared.items()]:
            lines += ["", f"not compared: {listed(others)}"]
        if any(own.error is not None for own in self.variables):
            lines += ["", f"The error is that of the run with steps of {short_number(self.step_sizes[-1])} s."]
            lines[-1] += " A single order may be chance: see `halvings=3`." if len(self.steps) == 3 else ""
        return page([*lines, *(f"warning: {warning}" for warning in self.warnings)])

    def __repr__(self) -> str:
        return f"<Convergence of {self._head}>"

    def _repr_html_(self) -> str:
        return html_table(self._head, _HEADING, self._cells(), len(self.variables))

    def _cells(self) -> Iterator[tuple[str, ...]]:
        for own in self.variables:
            if own.error is None:
                apart = own.differences[-1] / own.largest if own.largest else 0.0
                known = own.verdict == _SAME or not math.isfinite(apart)
                more = "" if known else f"; the two finest runs differ by {apart:.1g} of its largest value"
                yield own.name, "", "", "", "", f"{own.verdict}{more}"
            else:
                error, relative = f"{own.error:.2g} {own.unit or ''}".rstrip(), f"{own.error / own.largest:.1g}"
                yield own.name, f"{own.order:.2f}", f"{own.rms_order:.2f}", error, relative, ""

    @property
    def _head(self) -> str:
        return f"{self.mesh}: steps of {', '.join(map(short_number, self.step_sizes))} s"

    @checked
    def to_csv(self, path: str | Path) -> None:
        """Write the table as a CSV file, with a column for each difference.

        Raises:
            ConfigurationError: the file cannot be written.
        """
        text, fields = io.StringIO(), VariableConvergence.__struct_fields__[:-1]
        heading = [*fields, *(f"{one} s - {other} s" for one, other in pairwise(map(short_number, self.step_sizes)))]
        rows = ([*(getattr(own, name) for name in fields), *own.differences] for own in self.variables)
        csv.writer(text, lineterminator="\n").writerows([heading, *rows])
        write_whole(Path(path), text.getvalue(), "the table ")

    def plot(self, *, title: str | None = None) -> Figure:
        """Draw errors relative to the largest value of each variable, over the step size and over the steps of a run.

        Where there is no order, the differences between two runs are drawn.

        Raises:
            ConfigurationError: matplotlib is not installed.
        """
        curves = {}
        for own in self.variables:
            errors = np.array(own.differences)
            if own.order is not None and own.error is not None:  # that of a run is in proportion to its difference
                errors = own.error * np.append(2.0**own.order * errors / errors[-1], 1.0)
            if own.verdict != _SAME and np.isfinite([*errors, own.largest]).all():
                curves[own.name] = (errors / (own.largest or 1.0)).tolist()
        return convergence_figure(title or self.mesh, self.step_sizes, self.steps, curves)


@contextmanager
def converging(mesh: Mesh, options: ConvergenceOptions) -> Iterator[tuple[Sweep, Callable[[], Convergence]]]:
    """Start the runs, which end with the block, and what says at their end what was found; see `Mesh.convergence`."""
    given = options.given()
    of_run = {name: given.pop(name) for name in VariantOptions.__struct_fields__ if name in given}
    if "keys_from" in of_run:
        hint = "Its values belong to points: leave it out."
        raise CallRefused("`keys_from` for runs with other step sizes", hint=hint)
    plan = mesh.plan(**of_run, record="memory")
    if plan.plan.grid.stop_time is None:
        raise ConfigurationError(f"mesh '{plan.mesh}' has no end", hint="Give it one, with `stop_time=...`.")
    if not recorded_variables(plan.plan.system):
        raise ConfigurationError(f"mesh '{plan.mesh}' records nothing to compare", hint="Name `record.variables`.")
    instances = plan.plan.system.config.instances.items()
    sizes = {f"instances.{name}.step_size": own.step_size for name, own in instances if own.step_size is not None}
    sizes[_STEP] = plan.plan.grid.step_size
    # The finest begins first: it takes as long as all others together.
    variants = [{name: size / 2**n for name, size in sizes.items()} for n in reversed(range(options.halvings + 1))]
    # A run that explodes is an answer, too.
    of_run["config_values"] = {"simulation.not_finite": "record", **of_run.get("config_values", {})}
    of_run.pop("step_size", None)
    given.pop("halvings", None)
    try:  # before the others begin: an instance may have a fixed step of its own
        mesh.plan(**options_of_variant(of_run, mesh.instances, variants[0]), record="memory")
    except ConfigurationError as error:
        text = f"The finest run has steps of {short_number(variants[0][_STEP])} s"
        raise error.with_hint(f"{text}: choose fewer `halvings`, or a larger `step_size`.") from error
    with ExitStack() as stack:
        if options.folder is None:
            given["folder"] = stack.enter_context(TemporaryDirectory(prefix="fmu_mesh-", ignore_cleanup_errors=True))
        try:
            runs = stack.enter_context(sweep(mesh, variants, **of_run, **given))
            yield runs, partial(_found, runs, plan)
        except Interrupted as error:
            if options.folder is None:
                error.instead_of_hint("`folder=...` keeps its runs.")
            raise


def _found(runs: Sweep, plan: RunPlan) -> Convergence:
    """What the runs have found, all of which have ended; ``plan`` is that of the largest step size.

    Raises:
        FmuMeshError: one has failed; of the class that its exit code says.
    """
    variables = {name: own for name, (_, own) in recorded_variables(plan.plan.system).items()}
    names = [name for name, own in variables.items() if is_float(own.type) and own.variability != "discrete"]
    others = {name: "discrete" if is_float(own.type) else own.type for name, own in variables.items()}
    rows, warnings, curves = runs.result, list[str](), list[Columns]()
    sizes = tuple(plan.plan.grid.step_size / 2**number for number in range(len(rows)))
    for size, place in zip(sizes, reversed(range(len(rows))), strict=True):  # the finest began first
        row, what = rows[place], f"the run with steps of {short_number(size)} s"
        if row.exit_code:
            kinds = {one.exit_code: one for one in (ConfigurationError, FmuError, MeshLost)}
            hint = "Choose another `step_size`, or fewer `halvings`."
            raise kinds.get(row.exit_code, FmuMeshError)(f"{what} failed: {row.message}", hint=hint)
        warnings += [f"{what}: {row.message}"] if row.message else []
        own = rows.curves(place)
        # A step is halved exactly, so times of common points are the same floats.
        curves.append(_at(curves[-1].times if curves else own.times, own.times, {name: own[name] for name in names}))
    curves = [_at(curves[-1].times, *own[:2]) for own in curves]
    if not (points := len(curves[0].times)):
        raise ConfigurationError("the runs have recorded no common point", hint="Record every point.")
    last, instances = plan.plan.grid.last_point, plan.plan.system.instances.values()
    steps = tuple(sum(last // own.step_points for own in instances) << number for number in range(len(sizes)))
    judged = (
        _judged(name, variables[name].unit, [own.values[name] for own in curves], last << len(sizes) - 1)
        for name in names
    )
    others = {name: why for name, why in others.items() if name not in names}
    return Convergence(plan.mesh, sizes, steps, points, tuple(judged), others, tuple(warnings))


def _at(common: NDArray[np.float64], times: NDArray[np.float64], values: Mapping[str, NDArray[Any]]) -> Columns:
    kept = np.isin(times, common)
    return Columns(times[kept], {name: own[kept] for name, own in values.items()})


def _judged(name: str, unit: str | None, runs: Sequence[NDArray[Any]], steps: int) -> VariableConvergence:
    """Judge a variable by its values in all runs; ``steps`` are those of the finest one."""
    with np.errstate(all="ignore"):  # what explodes is not finite, or has no order
        differences = [np.abs(one - other) for one, other in pairwise(own.astype(np.float64) for own in runs)]
        most = np.array([one.max() for one in differences])
        rms = np.array([np.sqrt(np.square(one / one.max()).mean()) * one.max() for one in differences])
        by_most, by_rms = (np.log2(one[:-1] / one[1:]) for one in (most, rms))
        largest = float(np.abs(runs[-1]).max())
    # Each step may round once, and a value of 32 bits is rounded when it is an output.
    rounding = largest * max(steps * np.finfo(np.float64).eps, float(np.finfo(runs[-1].dtype).eps))
    # Where the range has not begun, one order may be plausible by chance: the last two of both norms have to agree.
    orders = [*by_most[-2:], *by_rms[-2:]]
    found: tuple[float | None, float | None, float | None] = None, None, None
    verdict = "not in the range where it converges"
    if not np.isfinite([*most, largest]).all():
        verdict += ": NaN or infinite"
    elif most[-1] <= rounding:
        verdict = _SAME
    elif not orders:
        verdict = "one more halving is needed to know"
    elif min(orders) >= _LEAST and max(orders) <= min(_LARGEST, min(orders) + _APART):
        error = float(most[-1] / (2.0 ** by_most[-1] - 1.0))
        if error < largest:  # otherwise no digit is right
            verdict, found = "converges", (float(by_most[-1]), float(by_rms[-1]), error)
    return VariableConvergence(name, unit, verdict, *found, largest, tuple(map(float, most)))
