"""Kubernetes: a mesh as one Job per process, and a headless Service by which the nodes find the master.

Exit codes 2 (configuration) and 3 (an FMU failed) end a Job. All others, such as 4 (a process was lost) or a kill for
memory, start a new pod: a lost node ends the master and all nodes, so all start again, from the first point.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any, Final

from .. import __version__
from ..config.yaml_text import written_for_others
from ..run.run_plan import RunPlan
from ..text import short_path
from .processes import INSIDE, PORT, MeshProcess, common_folder, identity_folder, inside, names_for, processes_of

__all__ = ["manifests"]

_SECURITY: Final = "/security"
_USER: Final = 10001
"""That of the image in docker/."""
_FINAL: Final = [2, 3]
"""Exit codes after which a new try would end in the same way."""
_RETRIES: Final = 6
_HEAD: Final = """\
# Mesh '{mesh}', written by fmu-mesh {version}, for `kubectl apply --filename FILE`.
# The volume of the claim '{claim}' has the folder of the mesh, with what '{folder}' has here.
{secrets}#
#   kubectl wait --for=condition=complete job/{master}
#   kubectl logs job/{master}
#   kubectl delete --filename FILE
"""


def manifests(run: RunPlan, options: Sequence[str | Path], *, image: str, claim: str | None = None) -> str:
    """Write the Jobs of a mesh, and the Service of its master.

    Secrets are only named: the comment on top has the commands that make them of the folders with certificates.

    Args:
        run: the plan.
        options: those of the command line with which it was made; all processes get them.
        image: an image whose entry point is `fmu-mesh`.
        claim: the PersistentVolumeClaim with the folder of the mesh; None: it has the name of the mesh.

    Raises:
        ConfigurationError: the mesh cannot be started in parts, or a container cannot have its files.
    """
    [mesh] = names_for([run.mesh], most=30)
    claim = claim or mesh
    address = f"master.{mesh}"
    processes = processes_of(run, options, address=address, port=str(PORT), security=lambda _role: _SECURITY)
    folder = common_folder(run, options)
    names = [f"{mesh}-{name}" for name in names_for([process.name for process in processes], most=25)]
    secrets = {}
    if run.loaded.config.security is not None:
        for role in ("master", "node"):
            own = identity_folder(run.loaded, role, address if role == "master" else None)
            secrets[role] = f"kubectl create secret generic {mesh}-{role} --from-file={short_path(own)}"
    results = sorted({Path(record.file).parent.resolve() for record in run.plan.system.records})
    writes = [(inside(own, folder), str(own.relative_to(folder))) for own in results]
    service = {
        "apiVersion": "v1",
        "kind": "Service",
        "metadata": {"name": mesh, "labels": _labels(mesh)},
        "spec": {
            "clusterIP": "None",
            "publishNotReadyAddresses": True,
            "selector": {**_labels(mesh), "fmu-mesh/process": names[0]},
            "ports": [{"name": "zenoh", "port": PORT}],
        },
    }
    jobs = [
        _job(name, mesh, _container(process, folder, image, writes), claim, secured=bool(secrets), role=process.role)
        for name, process in zip(names, processes, strict=True)
    ]
    head = _HEAD.format(
        mesh=run.mesh,
        version=__version__,
        claim=claim,
        folder=folder,
        secrets="".join(f"#   {command}\n" for command in secrets.values()),
        master=names[0],
    )
    return head + "---\n".join(written_for_others(one) for one in (service, *jobs))


def _labels(mesh: str) -> dict[str, str]:
    return {"app.kubernetes.io/name": "fmu-mesh", "app.kubernetes.io/instance": mesh}


def _container(process: MeshProcess, folder: Path, image: str, writes: Sequence[tuple[str, str]]) -> dict[str, Any]:
    is_master = process.role == "master"
    mounts: list[dict[str, Any]] = [
        {"name": "mesh", "mountPath": INSIDE, "readOnly": not (is_master and (INSIDE, ".") in writes)},
        {"name": "tmp", "mountPath": "/tmp"},  # noqa: S108  in the container
    ]
    if is_master:
        mounts += [{"name": "mesh", "mountPath": path, "subPath": sub} for path, sub in writes if sub != "."]
    memory = {} if process.memory is None else {"memory": str(process.memory)}
    limits = {"limits": memory} if memory else {}
    return {
        "name": "fmu-mesh",
        "image": image,
        "args": [inside(word, folder).replace("$(", "$$(") for word in process.words],
        "env": [{"name": "HOME", "value": "/tmp"}],  # noqa: S108  as above
        "resources": {"requests": {"cpu": "1", **memory}, **limits},
        "securityContext": {
            "allowPrivilegeEscalation": False,
            "readOnlyRootFilesystem": True,
            "capabilities": {"drop": ["ALL"]},
        },
        "volumeMounts": mounts,
    }


def _job(  # noqa: PLR0913  each is a part of the manifest
    name: str, mesh: str, container: dict[str, Any], claim: str, *, secured: bool, role: str
) -> dict[str, Any]:
    labels = {**_labels(mesh), "fmu-mesh/process": name}
    volumes: list[dict[str, Any]] = [
        {"name": "mesh", "persistentVolumeClaim": {"claimName": claim}},
        {"name": "tmp", "emptyDir": {}},
    ]
    if secured:
        secret = f"{mesh}-{'master' if role == 'master' else 'node'}"
        volumes.append({"name": "security", "secret": {"secretName": secret, "defaultMode": 0o400}})
        container["volumeMounts"].append({"name": "security", "mountPath": _SECURITY, "readOnly": True})
    pod: dict[str, Any] = {
        "restartPolicy": "Never",
        "automountServiceAccountToken": False,
        "enableServiceLinks": False,
        "securityContext": {
            "runAsNonRoot": True,
            "runAsUser": _USER,
            "runAsGroup": _USER,
            "fsGroup": _USER,
            "seccompProfile": {"type": "RuntimeDefault"},
        },
        "containers": [container],
        "volumes": volumes,
    }
    pod |= {"hostname": "master", "subdomain": mesh} if role == "master" else {}
    rules = [
        {"action": "FailJob", "onExitCodes": {"operator": "In", "values": _FINAL}},
        {"action": "Ignore", "onPodConditions": [{"type": "DisruptionTarget", "status": "True"}]},
    ]
    return {
        "apiVersion": "batch/v1",
        "kind": "Job",
        "metadata": {"name": name, "labels": labels},
        "spec": {
            "backoffLimit": _RETRIES,
            "podFailurePolicy": {"rules": rules},
            "template": {"metadata": {"labels": labels}, "spec": pod},
        },
    }
