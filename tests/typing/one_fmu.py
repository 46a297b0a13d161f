"""A user's program with one FMU, as type checkers see it with the installed package (`.ci/types`)."""

from pathlib import Path

from fmu_mesh import FMIAdapter, __version__
from fmu_mesh.adapter import FMIAdapter as Same
from fmu_mesh.errors import FmuMeshError, StepFailed


def angle(model: Path) -> float:
    """The angle of a pendulum after 2 s."""
    with FMIAdapter(model, step_size=0.02) as pendulum:
        pendulum.set_initial_value("a", 1.3)
        pendulum.exit_initialization_mode(0.0)
        reached: float = pendulum.do_steps_until(2.0)
        names: tuple[str, ...] = pendulum.output_variable_names
        default_step: float | None = pendulum.default_experiment_step
        print(reached, names, default_step)
        found: float = pendulum.get_output_value("a")
        return found


def step(adapter: Same) -> str | None:
    """Step, and tell what went wrong."""
    try:
        _ = adapter.do_step()
    except StepFailed as error:
        point: int | None = error.point
        print(point)
        return error.instance
    except FmuMeshError as error:
        return str(error.exit_code)
    return adapter.description.variables[0].unit


def mistaken(adapter: FMIAdapter) -> None:
    """What a type checker has to find; mypy and basedpyright complain about a comment that is not needed."""
    adapter.set_initial_value(1.3, "a")  # type: ignore[arg-type]  # pyright: ignore[reportArgumentType]
    adapter.do_steps("a")  # type: ignore[attr-defined]  # pyright: ignore[reportAttributeAccessIssue]


if __name__ == "__main__":
    print(angle(Path("fmus/DampedPendulum.fmu")), __version__)
