"""For mkdocstrings: what it does not know of our docstrings and signatures.

Our docstrings have a section `Example:`, and it only knows the name `Examples:`. The options of a call are the fields
of a Struct (`fmu_mesh.run.options.takes`), and it reads the source without running it.
"""

from __future__ import annotations

import inspect
import re
from functools import reduce
from importlib import import_module

from griffe import Extension, Function, Object, Parameter, ParameterKind, Parameters

_KINDS = {
    inspect.Parameter.POSITIONAL_OR_KEYWORD: ParameterKind.positional_or_keyword,
    inspect.Parameter.KEYWORD_ONLY: ParameterKind.keyword_only,
}


class ExamplesSection(Extension):
    """Renames the section, so that an example is shown as code, and shows the options of a call as its parameters."""

    def on_object(self, *, obj: Object, **_: object) -> None:
        """Rename it in the docstring of a module, a class or a function."""
        if obj.docstring is not None:
            obj.docstring.value = re.sub(r"^Example:$", "Examples:", obj.docstring.value, flags=re.MULTILINE)

    def on_function(self, *, func: Function, **_: object) -> None:
        """Take the signature and the docstring of a call with options from the imported function."""
        if not any(str(decorator.value).startswith("takes(") for decorator in func.decorators):
            return
        names = func.path.removeprefix(f"{func.module.path}.").split(".")
        call = reduce(getattr, names, import_module(func.module.path))
        own = [one for one in inspect.signature(inspect.unwrap(call)).parameters if one in ("self", "cls")]
        func.parameters = Parameters(
            *(Parameter(name, kind=ParameterKind.positional_or_keyword) for name in own),
            *(
                Parameter(
                    name,
                    annotation=str(one.annotation),
                    kind=_KINDS[one.kind],
                    default=None if one.default is inspect.Parameter.empty else repr(one.default),
                )
                for name, one in inspect.signature(call).parameters.items()
                if name not in own
            ),
        )
        if func.docstring is not None:
            func.docstring.value = inspect.getdoc(call) or ""
            self.on_object(obj=func)
