"""The figure that all pictures begin with. It imports matplotlib, so it is imported when something is drawn."""

from __future__ import annotations

from io import BytesIO

from matplotlib.figure import Figure

from .drawing import silently

__all__ = ["ShownFigure"]


class ShownFigure(Figure):
    """A figure that a notebook shows if it is the value of a cell, without a figure of pyplot.

    IPython draws figures of matplotlib only after `%matplotlib inline`, or when pyplot was imported: then it does not
    ask this class. Either way, a cell has one picture.
    """

    def _repr_png_(self) -> bytes:
        picture = BytesIO()
        with silently():
            self.savefig(picture, format="png")
        return picture.getvalue()
