"""Names of instances for the elements of a system, whose names are any text.

An instance is named after its element and the systems around it, with `-` between them: `SuT-motor`. A character that a
name of an instance cannot have is written as its code point between two `-`: `DP Controller` is `DP-32-Controller`. So
two elements never get one name, and `element_path` finds the element again.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from typing import Final

__all__ = ["WORLD", "element_path", "instance_name", "mesh_name"]

WORLD: Final = "world"
"""The name of the instance that is the world, where a configuration is made from an SDF world."""

_PART: Final = re.compile(r"-([0-9]+)-|(-)|([^-]+)")
_RESERVED: Final = "mesh"


def instance_name(path: Sequence[str]) -> str:
    """The name of an instance, from the names of the systems around its element, without the root system, and its own.

    Example:
        >>> instance_name(["DP Controller"]), instance_name(["SuT", "2nd.motor"]), instance_name(["mesh"])
        ('DP-32-Controller', 'SuT--50-nd-46-motor', '_-109-esh')
    """
    name = "-".join(map(_element, path))
    if name == _RESERVED:
        name = f"-{ord(name[0])}-{name[1:]}"
    return f"_{name}" if name.startswith("-") else name


def element_path(name: str) -> tuple[str, ...]:
    """The names of an element and of the systems around it; the inverse of `instance_name`.

    Example:
        >>> element_path("SuT--50-nd-46-motor")
        ('SuT', '2nd.motor')
    """
    encoded = name[1:] if re.match(r"_-[0-9]", name) else name
    path = [""]
    for match in _PART.finditer(encoded):
        if match[2]:
            path.append("")
        else:
            path[-1] += chr(int(match[1])) if match[1] else match[3]
    return tuple(path)


def mesh_name(text: str) -> str:
    """The name of a mesh for a text: what a name cannot have becomes `_`.

    Example:
        >>> mesh_name("DC-Motor"), mesh_name("2 motors")
        ('DC-Motor', '_2_motors')
    """
    name = re.sub(r"[^A-Za-z0-9_-]", "_", text)
    return name if re.match(r"[A-Za-z_]", name) else f"_{name}"


def _element(text: str) -> str:
    """One element in the characters of a name; it never begins with a digit that belongs to no code point."""
    encoded = "".join(
        one if re.fullmatch(r"[A-Za-z0-9_]", one) and not (place == 0 and one.isdigit()) else f"-{ord(one)}-"
        for place, one in enumerate(text)
    )
    # `_-` in front of a code point marks the start of a name.
    return f"-{ord('_')}-{encoded[1:]}" if encoded.startswith("_-") else encoded
