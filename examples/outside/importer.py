"""A program that takes part in the mesh of outside.yaml: its output is its input, times two."""

import sys

import fmu_mesh

with fmu_mesh.attach_as(sys.argv[1] if len(sys.argv) > 1 else "outside/importer", timeout=30.0) as me:
    me.begin()
    goes_on = True
    while goes_on:
        me.set("doubled", 2.0 * me.get("angle"))
        goes_on = me.step()
    print(f"the run has ended at {me.time:g} s")
