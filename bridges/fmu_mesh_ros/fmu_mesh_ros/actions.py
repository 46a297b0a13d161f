"""A mesh as an action of a launch file, with an event when it is ready; launch itself tells when it has ended.

Example, in `generate_launch_description`:
    mesh = Mesh(config="configs/pendulum_ros.yaml")
    ready = OnMeshReady(target_action=mesh, on_ready=[viewer])
    ended = OnProcessExit(target_action=mesh, on_exit=[Shutdown(reason="the mesh has ended")])
    return LaunchDescription([mesh, RegisterEventHandler(ready), RegisterEventHandler(ended)])
"""

from collections.abc import Iterable, Sequence
from pathlib import Path

from ament_index_python.packages import get_package_prefix
from launch import Event, EventHandler, LaunchContext, LaunchDescriptionEntity, SomeSubstitutionsType
from launch.actions import EmitEvent, ExecuteProcess, RegisterEventHandler
from launch.event_handlers import OnProcessExit
from launch.events import matches_action
from launch.events.process import ProcessExited, ShutdownProcess

__all__ = ["Mesh", "MeshReady", "OnMeshReady"]


class MeshReady(Event):
    """All instances of a mesh are initialized: it runs, or it is paused at its first point if that was asked for.

    Attributes:
        action: the `Mesh`.
    """

    name = "fmu_mesh_ros.MeshReady"

    def __init__(self, *, action: "Mesh") -> None:
        self.action = action


class OnMeshReady(EventHandler):
    """What is done when a mesh is ready.

    Args:
        target_action: the mesh.
        on_ready: actions.
    """

    def __init__(self, *, target_action: "Mesh", on_ready: Iterable[LaunchDescriptionEntity]) -> None:
        super().__init__(
            matcher=lambda event: isinstance(event, MeshReady) and event.action is target_action, entities=on_ready
        )


class Mesh(ExecuteProcess):
    """Runs a mesh, as `fmu-mesh launch` does; `OnProcessExit` has its exit code.

    Args:
        config: the configuration file, or a package of SSP.
        arguments: more arguments of `fmu-mesh launch`, such as ``["--real-time-factor", "1"]``.
        ready_timeout: how long to wait for the event `MeshReady`, in s; after that there is none, and the mesh goes on.
        options: more arguments of `launch.actions.ExecuteProcess`; ``output`` is ``screen`` unless they say otherwise.
    """

    def __init__(
        self,
        *,
        config: SomeSubstitutionsType,
        arguments: Sequence[SomeSubstitutionsType] = (),
        ready_timeout: float = 60.0,
        **options: object,
    ) -> None:
        folder = Path(get_package_prefix("fmu_mesh_ros")) / "lib/fmu_mesh_ros"
        # A pipe is no terminal, and a progress line would fill the log.
        command = [str(folder / "mesh"), config, "--no-progress", *arguments]
        super().__init__(cmd=command, **{"name": "mesh", "output": "screen", **options})
        state = "paused" if "--paused" in arguments else "running"
        self._waiting = ExecuteProcess(
            cmd=[str(folder / "wait"), config, "--state", state, "--timeout", f"{ready_timeout:g}"],
            name="mesh_ready",
            output="screen",
            on_exit=self._waited,
        )

    def execute(self, context: LaunchContext) -> list[LaunchDescriptionEntity]:
        """Start the mesh, and what waits for it; a mesh that ends before it is ready ends the wait, too."""
        stop = EmitEvent(event=ShutdownProcess(process_matcher=matches_action(self._waiting)))
        ended = RegisterEventHandler(OnProcessExit(target_action=self, on_exit=[stop]))
        return [ended, *(super().execute(context) or []), self._waiting]

    def _waited(self, event: ProcessExited, _context: LaunchContext) -> list[LaunchDescriptionEntity]:
        return [EmitEvent(event=MeshReady(action=self))] if event.returncode == 0 else []
