"""The table of instances: how far each is, how fast, and what it spends its time with."""

from __future__ import annotations

from typing import Any, Final

from nicegui import ui

from ..wire.views import InstanceStatus
from .mesh_follower import MeshView

__all__ = ["InstanceTable"]

_COLUMNS: Final = {
    "instance": "instance",
    "state": "state",
    "point": "point",
    "rate": "points/s",
    "step": "step time",
    "share": "computes, waits",
    "restarts": "restarts",
    "activity": "activity",
}
_BAR: Final = """
<q-td :props="props"><div class="fm-bar" role="img" :title="props.row.shares" :aria-label="props.row.shares">
<div :style="{width: props.row.share[0] + '%'}"></div><div :style="{width: props.row.share[1] + '%'}"></div>
</div></q-td>
"""


class InstanceTable:
    """A line for each instance, in the order of the mesh."""

    def __init__(self) -> None:
        columns = [
            {"name": name, "label": label, "field": name, "align": "left", "sortable": name != "share"}
            for name, label in _COLUMNS.items()
        ]
        self._table = ui.table(rows=[], columns=columns, row_key="instance").classes("fm-instances fm-numbers")
        self._table.props("dense flat hide-pagination virtual-scroll :rows-per-page-options=[0]")
        self._table.add_slot("body-cell-share", _BAR)

    def show(self, view: MeshView) -> None:
        """Show what is known now."""
        names = [name for name in view.infos if name in view.instances]
        rows = [_row(view.instances[name], view.before.get(name)) for name in names]
        if rows != self._table.rows:
            self._table.update_rows(rows)


def _row(own: InstanceStatus, before: InstanceStatus | None) -> dict[str, Any]:
    """The row of an instance in the table; rates and shares are those of the last second."""
    rate, *shares = own.rates_since(before)
    computes, waits = (100.0 * share for share in shares)
    return {
        "instance": own.instance,
        "state": own.state,
        "point": own.point,
        "rate": round(rate),
        "step": f"{1e6 * own.step_time:.3g} us",
        "share": [round(computes, 1), round(waits, 1)],
        "shares": f"{computes:.0f} % in its steps, {waits:.0f} % waiting",
        "restarts": own.restarts,
        "activity": own.activity.replace(f" at point {own.point}", "", 1),
    }
