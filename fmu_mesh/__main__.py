"""`python -m fmu_mesh`: the same as the command `fmu-mesh`."""

from .cli.main import main

if __name__ == "__main__":
    raise SystemExit(main())
