"""A user's program that starts, steers and watches a mesh, as type checkers see it."""

import asyncio

import fmu_mesh


def steered() -> fmu_mesh.Result:
    """Start a mesh, change a value while it runs, and stop it."""
    mesh = fmu_mesh.Mesh("steered", step_size=0.01, stop_time=60.0, real_time_factor=1.0)
    mesh.add("gain", fmu="fmus/Gain.fmu", start_values={"k": 2.0})
    with mesh.start(record="memory") as run:
        _ = run.set("gain.u", 3.0)
        _ = run.set("gain.k", 2.5, at=1.5)
        _ = run.pause()
        point: int = run.status.point
        print(point, run.get("gain.y"))
        _ = run.step(10)
        _ = run.reset(start_values={"gain.k": 1.5})
        _ = run.resume()
        run.stop()
        return run.wait(timeout=10.0)


def watched(name: str | None = None) -> None:
    """Look into a mesh that somebody else has started."""
    with fmu_mesh.attach(name, timeout=2.0) as run:
        for sample in run.watch("gain.y"):
            time: float = sample.time
            unit: str | None = sample.unit
            print(sample.point, time, sample.value, unit)


async def both(first: fmu_mesh.Mesh, second: fmu_mesh.Mesh) -> list[fmu_mesh.Result]:
    """Wait for two runs, without blocking the event loop."""
    with first.start() as one, second.start() as other:
        return list(await asyncio.gather(one.wait_async(), other.wait_async()))


def fate(run: fmu_mesh.Run) -> str:
    """What became of a run."""
    try:
        return run.wait().summary
    except fmu_mesh.StepFailed as error:
        return f"{error.instance} failed at point {error.point}"
    except (fmu_mesh.UnknownName, fmu_mesh.ConfigurationError) as error:
        return str(error)


def mistaken(run: fmu_mesh.Run) -> None:
    """What a type checker has to find."""
    _ = run.step("ten")  # type: ignore[arg-type]  # pyright: ignore[reportArgumentType]
    run.halt()  # type: ignore[attr-defined]  # pyright: ignore[reportAttributeAccessIssue]


if __name__ == "__main__":
    print(steered()["gain.y"])
