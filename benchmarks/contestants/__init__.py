"""One module per contestant: `python -m benchmarks.contestants.NAME TASK.json` runs it once and prints one JSON line.

All but our own run in an environment that holds the peers, so these modules import nothing of fmu_mesh.
"""
