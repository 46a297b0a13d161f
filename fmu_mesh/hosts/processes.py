"""The processes of a mesh as an engine starts them: what each runs, what it may take, and how they meet.

The master listens at a port, and all others connect to it. Knows no engine: `slurm_mesh`, `compose` and `kubernetes`
write the processes in the words of theirs.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Final

import msgspec

from ..config.loading import LoadedConfig
from ..errors import ConfigurationError
from ..files import archive_on_the_way
from ..run.run_plan import RunPlan
from ..system.plan import RECORDER
from ..text import listed, short_path

__all__ = ["INSIDE", "PORT", "MeshProcess", "common_folder", "identity_folder", "inside", "names_for", "processes_of"]

PORT: Final = 7447
"""Where the master listens, if it has an address of its own."""
INSIDE: Final = "/mesh"
"""Where a container has the folder of the mesh."""
_OWN_BYTES: Final = 256 << 20
"""What a node takes before it loads its models; `process: {memory}` is above that."""


class MeshProcess(msgspec.Struct, frozen=True):
    """One process of a mesh.

    Attributes:
        name: of the node; or `master`, `launch`, or `gateway`.
        role: `node`, `master`, `launch` or `gateway`.
        words: the arguments of `fmu-mesh`; a file is an absolute `Path`, which a container has elsewhere.
        memory: the most bytes that it needs; None: nobody knows.
        host: the host that the configuration names for it; None: any.
        python: the Python that has to run it; None: the usual one.
    """

    name: str
    role: str
    words: tuple[str | Path, ...]
    memory: int | None = None
    host: str | None = None
    python: str | None = None


def processes_of(
    run: RunPlan,
    options: Sequence[str | Path],
    *,
    address: str | None,
    port: str,
    security: Callable[[str], str | Path],
) -> tuple[MeshProcess, ...]:
    """The processes of a mesh, the master first, or the `launch` that starts all others on its host.

    Args:
        run: its plan, made with the same options.
        options: the options of all of them, as the command line takes them.
        address: where the others find the master; it may be a word of a shell. None: a `launch` starts them.
        port: that of the master, likewise.
        security: the folder of the certificate of a role where its process runs.

    Raises:
        ConfigurationError: the mesh cannot be started in parts; or nobody has said who may reach it.
    """
    config, plan, launched = run.loaded.config, run.plan, address is None
    if config.zenoh.mode == "client" and not launched:
        text = f"mesh '{run.mesh}' has `zenoh.mode: client`, and an engine starts processes that meet at the master"
        raise ConfigurationError(text, hint="Leave `mode` and `connect` out.")
    if config.security is None and not config.zenoh.insecure and not launched:
        text = f"the processes of mesh '{run.mesh}' meet at a network, and nobody has said who may reach it"
        hint = "Give `security=...` (`fmu-mesh security init` begins); or `insecure=True`: everybody there."
        raise ConfigurationError(text, hint=hint)
    if config.recovery.directory is not None and not launched:
        text = f"`recovery.directory` of mesh '{run.mesh}' has no effect where an engine starts its processes"
        hint = "Add `--set-config recovery.directory=null`. With Slurm, a mesh without a `host` can be resumed."
        raise ConfigurationError(text, hint=hint)
    nodes = [node for name, node in plan.nodes.items() if name != RECORDER]
    if boxed := [f"node '{node.node}'" for node in nodes if node.process.is_sandboxed]:
        text = f"`sandbox` of {listed(boxed)} has no effect where an engine starts the processes"
        raise ConfigurationError(text, hint="Write `sandbox: none`: a container is one, and the engine can say more.")
    scheme = "tcp" if config.security is None else "tls"

    def words(role: str, *own: str | Path) -> tuple[str | Path, ...]:
        access: tuple[str | Path, ...] = ("--insecure",) if config.zenoh.insecure else ()
        access = access if config.security is None else ("--security", security(role))
        if role == "launch":
            own = ("--no-progress",)
        elif role == "master":
            own = ("--listen", f"{scheme}/0.0.0.0:{port}", "--no-progress")
        else:
            own = (*own, "--connect", f"{scheme}/{address}:{port}")
        return (role, run.config_file, *own, *access, *options)

    first = "launch" if launched else "master"
    made = [MeshProcess(first, first, words(first))]
    for node in nodes:
        limit = node.process.memory_bytes
        memory = None if limit is None else limit + _OWN_BYTES
        made.append(MeshProcess(node.node, "node", words("node", node.node), memory, node.host, node.interpreter))
    if config.ros is not None and config.ros.profile != "rclpy":
        made.append(MeshProcess("gateway", "gateway", words("gateway")))
    return tuple(made)


def identity_folder(loaded: LoadedConfig, role: str, address: str | None = None) -> Path:
    """The folder with the certificate of a role, whose files are checked: DIR/master or DIR/node, or DIR for both.

    Args:
        loaded: a configuration with the section `security`.
        role: as of a `MeshProcess`.
        address: where others find it, if it listens and that is known.

    Raises:
        ConfigurationError: the folder is not complete, others can read its key, or its certificate is not for this.
    """
    from ..wire.security.certificates import hosts_in, identity_in  # noqa: PLC0415  it needs an optional library

    section = loaded.config.security
    assert section is not None
    folder = Path(section.folder)
    own = folder / ("master" if role == "master" else "node")
    folder = own if own.is_dir() else folder
    identity = identity_in(folder, section.roles or None)
    if identity.role not in ("node", None):
        text = f"'{identity.name}' of '{short_path(folder)}' is {identity.role}, and who runs a mesh has the role node"
        raise ConfigurationError(text, hint="`fmu-mesh security add` makes such a certificate.")
    if address is not None and address not in (hosts := hosts_in(folder)):
        text = f"the certificate in '{short_path(folder)}' listens as {listed(hosts)}, and the master is at {address}"
        hint = f"`fmu-mesh security renew {short_path(folder.parent)} {folder.name} --host {address}` adds it."
        raise ConfigurationError(text, hint=hint)
    return folder


def common_folder(run: RunPlan, options: Sequence[str | Path]) -> Path:
    """The folder that has the configuration, all that it names, and its results.

    Raises:
        ConfigurationError: there is none that a container should see, or a node needs another Python.
    """
    if others := [f"node '{node.node}'" for node in run.plan.nodes.values() if node.interpreter is not None]:
        text = f"{listed(others)} has an `interpreter`, which no container has"
        raise ConfigurationError(text, hint="Make an image with what the node needs, and leave `interpreter` out.")
    system = run.plan.system
    files = [run.config_file, *(Path(one.fmu) for one in system.instances.values() if one.fmu)]
    files += [Path(record.file) for record in system.records] + [Path(file) for file in system.scenario_files]
    files += [one for one in options if isinstance(one, Path)]
    folder = Path(os.path.commonpath([(archive_on_the_way(file) or file).parent.resolve() for file in files]))
    if folder in (Path("/"), Path.home(), Path("/home"), Path("/tmp")):  # noqa: S108  it is refused
        text = f"the files of mesh '{run.mesh}' are together only in '{folder}', which is too much for a container"
        raise ConfigurationError(text, hint="Put the configuration, the models and the results into one folder.")
    return folder


def inside(word: str | Path, folder: Path) -> str:
    """A word of a command in a container that has the folder of the mesh at `INSIDE`."""
    if not isinstance(word, Path):
        return word
    return str(Path(INSIDE) / (word.parent.resolve() / word.name).relative_to(folder))


def names_for(words: Sequence[str], *, most: int = 50) -> list[str]:
    """A name for each word, as DNS takes it: small letters, digits and `-`; no name twice.

    Example:
        >>> names_for(["master", "Pump_1", "pump-1", "_"])
        ['master', 'pump-1', 'pump-1-2', 'x']
    """
    names: list[str] = []
    for word in words:
        base = word.lower().replace("_", "-").strip("-")[:most].rstrip("-") or "x"
        base = base if base[0].isalpha() else f"x{base}"
        taken = [base, *(f"{base}-{number}" for number in range(2, len(words) + 1))]
        names.append(next(name for name in taken if name not in names))
    return names
