"""FMUs that define units."""

from __future__ import annotations

from pathlib import Path

from tests.fmus.packing import repacked

__all__ = ["with_units"]


def with_units(folder: Path, name: str, unit: str, base: str) -> Path:
    """The FMU Gain with a unit for its input and its output.

    Args:
        folder: where it goes.
        name: of the file, without its suffix.
        unit: the name of the unit.
        base: the attributes of its `BaseUnit`.
    """

    def changed(text: str) -> str:
        units = f'<UnitDefinitions><Unit name="{unit}"><BaseUnit {base}/></Unit></UnitDefinitions>'
        text = text.replace("<LogCategories>", f"{units}<LogCategories>", 1)
        for variable in ("u", "y"):
            before, _, after = text.partition(f'name="{variable}"')
            text = f'{before}name="{variable}"{after.replace("<Real", f"<Real unit={chr(34)}{unit}{chr(34)}", 1)}'
        return text

    return repacked(folder / f"{name}.fmu", description=changed)
