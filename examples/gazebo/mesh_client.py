"""A held mesh, stepped from outside: what a simulator needs to be the host of a mesh's FMUs.

Uses the open keys of a mesh (docs/key-space.md) and nothing else of the project, so that it runs in any Python that has
`zenoh`, such as that of a simulator.
"""

from __future__ import annotations

import json
import threading
import time
from collections.abc import Mapping, Sequence
from types import TracebackType
from typing import Any, Self

import zenoh

__all__ = ["HeldMesh", "MeshError"]


class MeshError(Exception):
    """The mesh is not there, refuses a value, or does not come to the next point."""


class HeldMesh:
    """A mesh that stands still but for `step`.

    Args:
        endpoint: where the mesh can be reached, as `fmu-mesh launch` prints it.
        mesh: its name.
        key_prefix: its `zenoh.key_prefix`.
        deadline_s: for every answer, in s.

    Attributes:
        point: the communication point at which the mesh stands.

    Raises:
        MeshError: by the constructor and by `step`.
    """

    def __init__(self, endpoint: str, mesh: str, key_prefix: str = "fmu_mesh", deadline_s: float = 10.0) -> None:
        self._prefix, self._deadline_s = f"{key_prefix}/{mesh}", deadline_s
        self._patience = threading.Event()  # never set
        config = zenoh.Config()
        config.insert_json5("mode", '"client"')
        config.insert_json5("scouting/multicast/enabled", "false")
        config.insert_json5("connect/endpoints", json.dumps([endpoint]))
        try:
            self._session = zenoh.open(config)
        except zenoh.ZError as error:
            raise MeshError(f"no mesh can be reached at {endpoint}: {error}") from error
        try:
            self.point = self._hold()
        except MeshError:
            self.close()
            raise

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def step(self, inputs: Mapping[str, float], outputs: Sequence[str]) -> list[float]:
        """Set inputs, take one step, return outputs; all named `instance.variable`."""
        for name, value in inputs.items():
            instance, _, variable = name.partition(".")
            self._ask(f"{instance}/set/{variable}", json.dumps(value))
        answer, _ = self._ask("mesh/command", '{"command":"step","points":1}')
        self.point = int(answer["hold"])
        return [self._output(name) for name in outputs]

    def stop(self) -> None:
        """End the mesh; its results stay."""
        self._ask("mesh/command", '{"command":"stop"}')

    def close(self) -> None:
        """Leave the mesh as it stands."""
        self._session.close()

    def _hold(self) -> int:
        """Hold the mesh once it runs, and return the point at which all its nodes have come to rest."""
        end, hold = time.monotonic() + self._deadline_s, None
        while time.monotonic() < end:
            status, _ = self._ask("mesh/status")
            if hold is None and status["state"] in ("running", "paused"):
                answer, _ = self._ask("mesh/command", '{"command":"pause"}')
                hold = int(answer["hold"])
            elif hold is not None and min(status["progress"].values()) >= hold:
                return hold
        raise MeshError(f"the mesh does not stand still within {self._deadline_s:g} s; it is {status['state']}")

    def _output(self, name: str) -> float:
        """The value at `point`."""
        instance, _, variable = name.partition(".")
        end = time.monotonic() + self._deadline_s
        while True:
            value, attachment = self._ask(f"{instance}/out/{variable}")
            if attachment["point"] >= self.point:
                return float(value)
            if time.monotonic() > end:
                raise MeshError(f"'{name}' is still at point {attachment['point']}, not {self.point}")

    def _ask(self, key: str, payload: str | None = None) -> tuple[Any, Any]:
        """The answer to a query and its attachment."""
        end = time.monotonic() + self._deadline_s
        # A session learns only after it has opened who can be asked; until then a query ends without any reply.
        while (left := end - time.monotonic()) > 0:
            for reply in self._session.get(f"{self._prefix}/{key}", payload=payload, timeout=left):
                if reply.ok is None:
                    text = reply.err.payload.to_string() if reply.err is not None else "no answer"
                    raise MeshError(f"{key}: {text}")
                attachment = reply.ok.attachment
                return (
                    json.loads(reply.ok.payload.to_string()),
                    json.loads(attachment.to_string()) if attachment is not None else None,
                )
            self._patience.wait(0.01)
        raise MeshError(f"{self._prefix}/{key} does not answer within {self._deadline_s:g} s; does the mesh run?")
