"""A user's program that steps a mesh by hand, as type checkers see it."""

from pathlib import Path

import fmu_mesh


def angle(file: Path) -> float:
    """The angle after 1 s, and after 100 more steps that are taken back."""
    with fmu_mesh.load(file).open(start_values={"pendulum.a": 1.0}) as system:
        while system.time < 1.0:
            system.step()
        state = system.save()
        system.step(100)
        system.restore(state)
        point: int = system.point
        found: float = system.get("pendulum.a")
        print(point, system.time)
        return found


def mistaken(mesh: fmu_mesh.Mesh) -> None:
    """What a type checker has to find."""
    with mesh.open() as system:
        system.step("ten")  # type: ignore[arg-type]  # pyright: ignore[reportArgumentType]


if __name__ == "__main__":
    print(angle(Path("configs/pendulum_delay.yaml")))
