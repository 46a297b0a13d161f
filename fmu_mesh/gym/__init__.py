"""A mesh as an environment of Gymnasium: one copy, or many copies of a batch that are stepped in one call.

    import fmu_mesh.gym

    task = fmu_mesh.gym.Task(mesh="configs/cart_pole.yaml", observations=..., actions=..., reward=...)
    environment = fmu_mesh.gym.MeshEnv(task)
    environments = fmu_mesh.gym.MeshVectorEnv(task, num_envs=1024)

It needs the library gymnasium, which `import fmu_mesh` does not import (docs/learning.md).
"""

from ..installing import importing

with importing("gymnasium"):
    from .environments import MeshEnv, MeshVectorEnv
from .task import Step, Task

__all__ = ["MeshEnv", "MeshVectorEnv", "Step", "Task"]
