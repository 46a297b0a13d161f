"""The curves of the dashboard can be seen on a light and on a dark page."""

from __future__ import annotations

import re

import pytest

from fmu_mesh.dashboard.dashboard_server import STATIC


def _luminance(colour: str) -> float:
    """The relative luminance of a colour such as `#0072b2` (WCAG 2.2)."""
    parts = [int(colour[at : at + 2], 16) / 255.0 for at in (1, 3, 5)]
    linear = [part / 12.92 if part <= 0.04045 else ((part + 0.055) / 1.055) ** 2.4 for part in parts]
    return 0.2126 * linear[0] + 0.7152 * linear[1] + 0.0722 * linear[2]


@pytest.mark.parametrize(("theme", "ground"), [("default", "#ffffff"), ("dark", "#1d1d1d")])
def test_each_colour_of_a_curve_has_a_contrast_of_three(theme: str, ground: str) -> None:
    script = (STATIC / "plots.js").read_text(encoding="utf-8")
    line = re.search(rf"^ *{theme}: \[(.*)\],$", script, re.MULTILINE)
    assert line is not None
    colours = re.findall(r"#\w{6}", line[1])

    light = {colour: sorted((_luminance(colour), _luminance(ground))) for colour in colours}

    assert len(colours) == 8
    assert [colour for colour, (low, high) in light.items() if (high + 0.05) / (low + 0.05) < 3.0] == []
