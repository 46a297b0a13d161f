"""The figure that all pictures begin with. It imports matplotlib, so it is imported when something is drawn."""

from __future__ import annotations

import warnings
from io import BytesIO

from matplotlib.figure import Figure

__all__ = ["ShownFigure"]


class ShownFigure(Figure):
    """A figure that a notebook shows if it is the value of a cell, without a figure of pyplot.

    IPython draws figures of matplotlib only after `%matplotlib inline`, or when pyplot was imported: then it does not
    ask this class. Either way, a cell has one picture.
    """

    def _repr_png_(self) -> bytes:
        picture = BytesIO()
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # a character that is not in the font is drawn as a box
            self.savefig(picture, format="png")
        return picture.getvalue()
