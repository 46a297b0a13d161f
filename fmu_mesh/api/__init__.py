"""The library: meshes, runs and results for Python programs. `import fmu_mesh` offers its names."""
