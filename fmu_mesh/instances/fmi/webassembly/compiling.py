"""Compiles the sources of an FMU for WebAssembly, into a library that looks like any other (ADR 101).

Owns the two C files of the sandbox, and the compiler. The library has the module in it, as wasmtime has compiled it for
this processor, and calls the library of wasmtime where it is now.
"""

from __future__ import annotations

import importlib.util
import re
import sys
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Final

from msgspec.structs import replace

from .... import files
from ....errors import LoadFailed
from ....installing import version_of_library
from ....variables.model_description import ModelDescription

if TYPE_CHECKING:
    import wasmtime

__all__ = ["FOLDER", "as_guest", "compiler", "environment", "make_library"]

FOLDER: Final = Path(__file__).parent
"""That of the C files."""

_TARGET: Final = ("-target", "wasm32-wasi", "-O2", "-g0", "-ffp-contract=off", "-fvisibility=default")
_REACTOR: Final = ("-mexec-model=reactor", "-rdynamic", "-Wl,--export=__stack_pointer", "-Wl,-z,stack-size=1048576")
_HOST_FLAGS: Final = ("-std=gnu23", "-O2", "-g0", "-fPIC", "-shared", "-fvisibility=hidden")


def as_guest(path: Path, model: ModelDescription, memory: int) -> ModelDescription:
    """The description of an FMU that runs in a sandbox with so many bytes.

    What is compiled for it can get, set and serialize its state; a component is as it says.

    Raises:
        LoadFailed: it is an FMU of FMI 1.0.
    """
    if model.runs == "wasm":
        return replace(model, guest_memory=memory)
    if model.fmi_version.startswith("1."):
        raise LoadFailed(f"'{path}' is an FMU of FMI 1.0, and `sandbox: wasm` is for those of FMI 2.0 and 3.0.")
    able = {"can_get_and_set_state": True, "can_serialize_state": True}
    return replace(model, library=None, guest_memory=memory, **able)


def compiler(*, plus: bool) -> list[str]:
    """The command that compiles for WebAssembly, and the version of wasmtime for the key of what it makes.

    Raises:
        LibraryMissing: ziglang or wasmtime is not installed, or has another version than the extra `wasm`.
    """
    version_of_library("ziglang")
    version = version_of_library("wasmtime")
    # Nothing that a guest throws could be caught: the compiler has no exceptions for WebAssembly.
    flags = ["-fno-exceptions"] if plus else []
    return [sys.executable, "-m", "ziglang", "c++" if plus else "cc", *_TARGET, *flags, f"-DWASMTIME={version}"]


def environment() -> dict[str, str]:
    """Where the compiler keeps its C library for WebAssembly, which it compiles once."""
    return {f"ZIG_{which}_CACHE_DIR": str(files.cache_folder() / "zig") for which in ("GLOBAL", "LOCAL")}


def make_library(
    fmi_version: str, identifier: str, command: Sequence[str], draft: Path, run: Callable[[Sequence[str]], None]
) -> None:
    """Make the library ``draft``; ``command`` compiles the sources, and ``run`` runs a command in its folder.

    Raises:
        LoadFailed: the compiler or wasmtime refuses something.
    """
    folder, cc = draft.parent, [sys.executable, "-m", "ziglang", "cc"]
    options = [f"-DFMI={fmi_version[0]}"]
    shim, module = folder / "guest.o", folder / "guest.wasm"
    run([*cc, *_TARGET, *options, f"-DPREFIX={identifier}", "-c", str(FOLDER / "guest.c"), "-o", str(shim)])
    run([*command, str(shim), *_REACTOR, "-o", str(module)])
    compiled = _compiled(module.read_bytes())
    (folder / "module.bin").write_bytes(compiled.serialize())
    names = [export.name for export in compiled.exports if re.fullmatch(r"\w*fmi\w+", export.name)]
    prefix = next((name.partition("fmi")[0] for name in names if name.endswith("fmi2Instantiate")), "")
    own = [name.removeprefix(prefix) for name in names]
    states = [
        f"{verb}FMU{'s' if fmi_version[0] == '2' else 'S'}tate*" for verb in ("*Get", "*Set", "*Free", "*erialize")
    ]
    visible = "; ".join([*own, *states, "*Serialized*", "fmu_mesh_guest_limits"])
    (folder / "functions").write_text(f"{{ global: {visible}; local: *; }};\n", encoding="utf-8")
    spec = importlib.util.find_spec("wasmtime")
    package = Path(spec.origin or "").parent if spec is not None else Path()
    if (found := next(package.glob("*/_libwasmtime.so"), None)) is None:
        raise LoadFailed("wasmtime has no library for this platform.")
    options += [f'-DPREFIX="{prefix}"', f'-DIDENTITY="{draft.parents[1].name}"', f"-I{folder}"]
    run(
        [
            *cc,
            *_HOST_FLAGS,
            *options,
            str(FOLDER / "host.c"),
            str(found),
            f"-Wl,-rpath,{found.parent}",
            f"-Wl,--version-script={folder / 'functions'},--undefined-version",
            "-o",
            str(draft),
        ]
    )


def _compiled(module: bytes) -> wasmtime.Module:
    """A module, compiled for this processor as `host.c` runs it."""
    import wasmtime  # noqa: PLC0415  an optional library

    config = wasmtime.Config()
    config.epoch_interruption = True
    try:
        return wasmtime.Module(wasmtime.Engine(config), module)
    except wasmtime.WasmtimeError as error:
        raise LoadFailed(f"wasmtime cannot compile it: {error}") from error
