"""`graph`: the graph of a configuration or of a running mesh, as text or as a picture."""

from __future__ import annotations

import argparse
from pathlib import Path

from ..api.attaching import attach
from ..api.mesh_builder import load
from ..errors import ConfigurationError
from ..files import write_whole
from ..pictures.drawing import draw
from ..pictures.system_graph import SystemGraph
from ..run.options import VariantOptions
from ..ssp.configuration_files import names_package
from .arguments import Runs, reach
from .output.json_output import print_json
from .run_options import given_options

__all__ = ["RUNS"]

_CONFIGURATIONS = (".yaml", ".yml")


def _graph(arguments: argparse.Namespace) -> int:
    output = arguments.output
    if output is not None and output.suffix.lower() not in (".svg", ".png", ".pdf", ".txt"):
        raise ConfigurationError(f"a graph cannot be written as '{output}'.", hint="Name it .svg, .png, .pdf or .txt.")
    graph = _graph_of(arguments)
    if output is not None:
        write(graph, output)
    if arguments.json:
        print_json(graph)
    elif output is not None:
        print(f"graph: {output}")
    else:
        print(graph.text())
    return 0


def _graph_of(arguments: argparse.Namespace) -> SystemGraph:
    of = arguments.of
    chooses = arguments.ssd is not None or arguments.ssv
    if of is None and chooses:
        raise ConfigurationError("--ssd and --ssv choose a variant of a package of SSP, and none is named")
    path = Path(of or "")
    is_configuration = path.suffix.lower() in _CONFIGURATIONS or path.is_file() or names_package(path)
    if of is not None and (chooses or is_configuration):
        given = given_options(arguments, VariantOptions)
        return load(of, ssd=arguments.ssd, ssv=arguments.ssv).graph(**given)
    with attach(of, **reach(arguments)) as run:
        return run.graph()


def write(graph: SystemGraph, output: Path) -> None:
    """Write a graph into a file; its suffix gives the format."""
    suffix = output.suffix.lower()
    if suffix in (".png", ".pdf"):
        draw(graph.figure(), output)
    else:
        write_whole(output, graph.svg() if suffix == ".svg" else f"{graph.text()}\n", "the graph ", make_folder=True)


RUNS: Runs = {"graph": _graph}
