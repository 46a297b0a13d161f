"""From one format of a configuration to another: a package of SSP to YAML, and a mesh to a package."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, Final, Literal

from ..config.findings import Findings
from ..config.loading import PlainConfig
from ..errors import ConfigurationError, Finding
from ..files import write_whole
from ..instances.configuration import examine_data
from ..run.allowed_code import check_code
from ..run.options import PlanOptions
from ..run.overriding import with_options
from ..ssp.configuration_files import named_package, read_configuration
from ..ssp.package import RESULT_BESIDE_PACKAGE
from ..text import short_path
from .mesh_builder import Mesh
from .package_inspection import inspect_package

__all__ = ["convert"]

_YAML: Final = (".yaml", ".yml")
_PACKAGE: Final = ".ssp"

Version = Literal["1.0", "2.0"]


def convert(  # noqa: PLR0913  keywords, each of which stands alone
    source: Path,
    target: Path,
    *,
    ssd: str | None = None,
    ssv: Sequence[str | Path] = (),
    version: Version | None = None,
    simulation: Mapping[str, Any] = {},
) -> tuple[Finding, ...]:
    """Write a configuration in another format: the ending of ``target`` chooses YAML or a package of SSP.

    Example:
        >>> convert(Path("configs/pendulum_delay.yaml"), Path("pendulum.yaml"))
        ()
        >>> import fmu_mesh
        >>> fmu_mesh.load("pendulum.yaml").instances
        ['pendulum', 'delay']

    Args:
        source: what `fmu_mesh.load` reads.
        target: a .yaml, .yml or .ssp file; a file that exists is replaced.
        ssd: which description of a package.
        ssv: files with values that replace those of a package, as for `fmu_mesh.load`.
        version: of SSP; None: that of the package that is read, or 1.0.
        simulation: keys of the section `simulation`, in the place of what ``source`` says.

    Returns:
        What ``source`` says and ``target`` does not, and the code that only ``target`` may name.

    Raises:
        ConfigurationError: ``source`` is wrong, or ``target`` cannot be written; nothing is left of it.
    """
    suffix = target.suffix.lower()
    if suffix not in (*_YAML, _PACKAGE):
        raise ConfigurationError(f"'{target}' is no format of a configuration", hint="Name it .yaml or .ssp.")
    if version is not None and suffix != _PACKAGE:
        raise ConfigurationError(f"`version=...` is that of a package of SSP, and '{target}' is none")
    given = read_configuration(source, ssd, ssv)
    mesh = Mesh.from_configuration(given)
    if simulation:
        mesh.configure(simulation=dict(simulation))
    needed = with_options(given, PlanOptions())
    findings = Findings(str(needed.file), first=needed.findings)
    findings.raise_any()
    if suffix == _PACKAGE:
        return mesh.to_ssp(target, version=version)
    if isinstance(given.data, dict) and given.data.get("record") == {"file": RESULT_BESIDE_PACKAGE}:
        del given.data["record"]  # the result file of the new configuration is beside that
    told: list[str] = []
    check_code(examine_data(given)[0], Findings(""), told.append, "which this file may name, as it is your own")
    comment = "".join(f"# {line}".rstrip() + "\n" for line in _comment(source, ssd, given))
    write_whole(target, comment + mesh.to_yaml(target.parent))
    return *given.warnings, *(Finding(str(target), "", text, "") for text in told)


def _comment(source: Path, ssd: str | None, given: PlainConfig) -> Iterator[str]:
    """What the file was made from, which names have changed, and what was left out."""
    yield f"Converted from {_one_line(short_path(given.file))} by fmu-mesh."
    if named_package(source, ssd) is None:
        return
    elements = inspect_package(source, ssd=ssd).elements
    renamed = [own for own in elements if own.instance is not None and own.path != (own.instance,)]
    if renamed:
        yield ""
        yield "Instances, and the elements of the package that they are:"
        yield from (f"  {own.instance}: {_one_line(' / '.join(own.path))}" for own in renamed)
    if given.warnings:
        yield ""
        yield "What the package says and this file does not, or what may be wrong with it:"
        yield from (f"  {_one_line(str(warning))}" for warning in given.warnings)


def _one_line(text: str) -> str:
    """A text of a package as a part of a comment: it must not end the line."""
    return " ".join(text.split())
