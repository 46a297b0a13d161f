"""Benchmarks: fmu_mesh and its peers on the same FMUs, interleaved, on one machine; see `docs/performance.md`."""
