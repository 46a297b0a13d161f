"""A page in a browser that shows running meshes and steers them.

A user of `fmu_mesh.api`, as any other program could be. Nothing here prints; `fmu_mesh.cli.dashboard` is the command.
"""
