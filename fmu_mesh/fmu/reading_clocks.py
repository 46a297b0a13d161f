"""The clocks of an FMI 3.0 model description, of whose attributes FMPy reads one only."""

from __future__ import annotations

import zipfile
from pathlib import Path
from typing import Any, cast

from lxml import etree

from ..model.description import Causality, Clock

__all__ = ["read_clocks"]


def read_clocks(path: Path) -> tuple[Clock, ...]:
    """The clocks of the FMU at ``path``, whose description has been read and found good before."""
    with zipfile.ZipFile(path) as archive:
        data = archive.read("modelDescription.xml")
    parser = etree.XMLParser(resolve_entities=False, no_network=True, load_dtd=False)
    return tuple(_clock(element) for element in etree.fromstring(data, parser).iterfind("ModelVariables/Clock"))


def _clock(element: Any) -> Clock:  # noqa: ANN401 lxml has no types here
    """A clock; one that has a fraction for an interval counts in units of its resolution (FMI 3.0, 2.2.8.4)."""
    interval, shift = element.get("intervalDecimal"), element.get("shiftDecimal")
    counter, resolution = element.get("intervalCounter"), element.get("resolution")
    if counter is not None and resolution is not None:
        interval, shift = int(counter) / int(resolution), int(element.get("shiftCounter", 0)) / int(resolution)
    return Clock(
        name=element.get("name"),
        value_reference=int(element.get("valueReference")),
        causality=cast("Causality", element.get("causality", "local")),
        interval_variability=element.get("intervalVariability", "triggered"),
        interval=float(interval) if interval is not None else None,
        shift=float(shift or 0.0),
    )
