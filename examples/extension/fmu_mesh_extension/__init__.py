"""What this package adds to fmu_mesh; `docs/extending.md` explains it."""
