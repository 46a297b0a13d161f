"""Compose: a mesh as a file of services, one per process, for `docker compose` and `podman-compose`."""

from __future__ import annotations

import os
from collections.abc import Sequence
from pathlib import Path
from typing import Any, Final

from .. import __version__
from ..config.yaml_text import written_for_others
from ..run.run_plan import RunPlan
from .processes import INSIDE, PORT, common_folder, identity_folder, inside, names_for, processes_of

__all__ = ["compose_file"]

_SECURITY: Final = "/security"
_HEAD: Final = """\
# Mesh '{mesh}', written by fmu-mesh {version}. The exit code of the first command is that of the run:
#
#   docker compose --file FILE run --rm --name {address} {master}
#   docker compose --file FILE down
#
# All processes have the folder of the mesh at {inside}, to read it; the master writes the results.
"""


def compose_file(run: RunPlan, options: Sequence[str | Path], *, image: str) -> str:
    """Write the file of a mesh, whose services run on the host with the folder of the mesh, in a network of their own.

    The folders of its results are made.

    Args:
        run: the plan.
        options: those of the command line with which it was made; all processes get them.
        image: an image whose entry point is `fmu-mesh`.

    Raises:
        ConfigurationError: the mesh cannot be started in parts, or a container cannot have its files.
    """
    [mesh] = names_for([run.mesh])
    address = f"{mesh}-master"  # a container that `run` starts is found by its name only
    processes = processes_of(run, options, address=address, port=str(PORT), security=lambda _role: _SECURITY)
    folder = common_folder(run, options)
    names = names_for([process.name for process in processes])
    results = sorted({Path(record.file).parent.resolve() for record in run.plan.system.records})
    for own in results:
        own.mkdir(parents=True, exist_ok=True)  # an engine would make it for itself
    services: dict[str, Any] = {}
    for name, process in zip(names, processes, strict=True):
        is_master = process.role == "master"
        mounts = [_mount(folder, INSIDE, read_only=not (is_master and folder in results))]
        if is_master:
            mounts += [_mount(own, inside(own, folder), read_only=False) for own in results if own != folder]
        if run.loaded.config.security is not None:
            own = identity_folder(run.loaded, process.role, address if is_master else None)
            mounts.append(_mount(own, _SECURITY))
        services[name] = {
            "image": image,
            "command": [_word(inside(word, folder)) for word in process.words],
            "user": f"{os.getuid()}:{os.getgid()}",  # who can read the files, and whose the results are
            "environment": {"HOME": "/tmp"},  # noqa: S108  in the container
            "init": True,
            "restart": "no",
            "stop_grace_period": "5s",
            "cap_drop": ["ALL"],
            "security_opt": ["no-new-privileges:true"],
            "networks": ["mesh"],
            "volumes": mounts,
        }
        services[name] |= {"mem_limit": process.memory} if process.memory is not None else {}
        services[name] |= {"container_name": address, "depends_on": names[1:]} if is_master else {}
    whole: dict[str, Any] = {
        "name": mesh,
        "services": services,
        "networks": {"mesh": {"internal": True}},
    }
    head = _HEAD.format(mesh=run.mesh, version=__version__, address=address, master=names[0], inside=INSIDE)
    return head + written_for_others(whole)


def _mount(source: Path, target: str, *, read_only: bool = True) -> dict[str, Any]:
    return {"type": "bind", "source": _word(str(source)), "target": _word(target), "read_only": read_only}


def _word(text: str) -> str:
    """A text in which Compose replaces nothing."""
    return text.replace("$", "$$")
