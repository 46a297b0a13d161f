"""For mkdocstrings: our docstrings have a section `Example:`, and it only knows the name `Examples:`."""

from __future__ import annotations

import re

from griffe import Extension, Object


class ExamplesSection(Extension):
    """Renames the section, so that an example is shown as code."""

    def on_object(self, *, obj: Object, **_: object) -> None:
        """Rename it in the docstring of a module, a class or a function."""
        if obj.docstring is not None:
            obj.docstring.value = re.sub(r"^Example:$", "Examples:", obj.docstring.value, flags=re.MULTILINE)
