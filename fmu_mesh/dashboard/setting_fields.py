"""The element with which a person sets a variable: which one fits its type, and what is sent."""

from __future__ import annotations

import json
import math
from collections.abc import Awaitable, Callable
from typing import Any, Final

import numpy as np
from nicegui import ui

from ..wire.views import VariableView

__all__ = ["SettingField"]

_STEPS: Final = 200
_THROTTLE_S: Final = 0.1
_REALS: Final = ("Real", "Float64", "Float32")


class SettingField:
    """One line of the page: the name, the element, and the answer of the mesh.

    * a Boolean: a switch
    * an Enumeration: a choice of its items
    * a number with a minimum and a maximum: a slider and a field
    * any other number: a field
    * a text, or an array as JSON: a field
    """

    def __init__(self, name: str, variable: VariableView, apply: Callable[[str, object], Awaitable[None]]) -> None:
        self._name = name
        self._variable = variable
        self._apply = apply
        self._shown: object = variable.start
        self._slider: Any = None
        with ui.element("div").classes("fm-field"):
            unit = f" in {variable.unit}" if variable.unit else ""
            label = ui.label(f"{name}{unit}").classes("fm-name")
            if variable.description:
                label.tooltip(variable.description)
            self._element = self._make()
            for element in (self._element, self._slider):
                if element is not None:
                    element.props["aria-label"] = name
            self._answer = ui.label().classes("text-caption fm-numbers")

    def show(self, value: Any) -> None:  # noqa: ANN401  the type follows from the variable
        """Show the value that the mesh has, unless a person is just changing it."""
        plain = value.tolist() if isinstance(value, np.ndarray | np.generic) else value
        if plain == self._shown or isinstance(plain, bytes):
            return
        self._shown = plain
        if self._variable.shape:
            plain = json.dumps(plain)
        elif isinstance(plain, float) and not math.isfinite(plain):
            return
        for element in (self._element, self._slider):
            if element is not None:
                element.set_value(plain)

    def say(self, text: str) -> None:
        """Show the answer of the mesh."""
        self._answer.set_text(text)

    def _make(self) -> Any:  # noqa: ANN401  an element of NiceGUI
        variable, start = self._variable, self._variable.start
        if variable.shape or variable.type in ("String", "Binary"):
            element = ui.input(value=json.dumps(start) if variable.shape else str(start or ""))
            return self._field(element, self._text)
        if variable.type == "Boolean":
            return ui.switch(value=bool(start)).on("update:model-value", lambda event: self._send(_first(event)))
        if variable.items:
            options = {number: item for item, number in variable.items}
            choice = ui.select(options, value=start if start in options else None).props("dense outlined")
            return choice.on_value_change(lambda event: self._send(event.value))
        value = start if isinstance(start, int | float) else 0
        field = ui.number(value=value, format="%.7g", min=variable.minimum, max=variable.maximum)
        low, high = variable.minimum, variable.maximum
        if low is not None and high is not None and math.isfinite(high - low) and low < high:
            with ui.row().classes("no-wrap items-center").style("gap: 12px"):
                self._slider = self._make_slider(low, high, value)
                field.move(ui.context.slot.parent)
                field.style("width: 104px")
        return self._field(field, float if variable.type in _REALS else int)

    def _make_slider(self, low: float, high: float, value: float) -> Any:  # noqa: ANN401  an element of NiceGUI
        whole = self._variable.type not in _REALS
        step = max(1.0, round((high - low) / _STEPS)) if whole else (high - low) / _STEPS
        slider = ui.slider(min=low, max=high, step=step, value=value).style("min-width: 90px")
        # Only what a person does; a value that is shown sends nothing.
        slider.on("update:model-value", lambda event: self._slide(_first(event)), throttle=_THROTTLE_S)
        return slider

    async def _slide(self, value: Any) -> None:  # noqa: ANN401  what the browser sends
        self._element.set_value(value)
        await self._send(int(value) if self._variable.type not in _REALS else float(value))

    def _field(self, element: Any, read: Callable[[Any], object]) -> Any:  # noqa: ANN401  an element of NiceGUI
        """A field that sends what is in it after Enter, and when it is left."""

        async def sent() -> None:
            try:
                value = read(element.value)
            except (ValueError, TypeError):
                ui.notify(f"{self._name}: {element.value!r} is no value of type {self._variable.type}", type="negative")
                return
            await self._send(value)

        return element.props("dense outlined").on("keydown.enter", sent).on("blur", sent)

    def _text(self, text: str) -> object:
        return json.loads(text) if self._variable.shape else text

    async def _send(self, value: object) -> None:
        """Set the value, unless it is the one that is shown already."""
        if value != self._shown:
            self._shown = value
            if self._slider is not None:
                self._slider.set_value(value)
            await self._apply(self._name, value)


def _first(event: Any) -> Any:  # noqa: ANN401  what the browser sends
    return event.args[0] if isinstance(event.args, list) else event.args
