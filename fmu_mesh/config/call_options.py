"""Options of a call, each in one field of a Struct: its flag, its place in a signature, its line of help, its check.

Owns no option: `fmu_mesh.run.options` lists those of a run. A value is checked where it is given (`takes`); what a key
of the configuration may have is checked with the file. Knows nothing of argparse.
"""

import inspect
import re
from collections.abc import Callable, Iterable, Mapping, Sequence
from functools import cache, wraps
from inspect import Parameter, Signature, signature
from types import NoneType
from typing import (
    Any,
    Concatenate,
    Generic,
    Literal,
    ParamSpec,
    TypeVar,
    get_args,
    get_origin,
    get_type_hints,
    overload,
)

import msgspec
from msgspec.structs import force_setattr, replace

from ..errors import CallRefused
from ..text import nearest, option_text
from .plain_values import kinds_of, taken

__all__ = ["CallOptions", "Option", "checked", "option_fields", "takes"]

O = TypeVar("O")  # noqa: E741  options
P = ParamSpec("P")
R = TypeVar("R")
S = TypeVar("S")
T = TypeVar("T")


class Option(msgspec.Struct, frozen=True):
    """An option: what its field says beside its type, and what follows from the field.

    Attributes:
        text: one line about it; None: the description of its key.
        flag: how the command line spells it, with its dashes; None if only a program has it.
        metavar: what stands for its value in the help.
        key: key of the configuration that it replaces.
        bare: its value where the flag is given without one; None if it needs a value.
        least: its smallest value, where no key says it.
        parameter: it as a parameter of a call.
        kinds: the types that it takes.
    """

    text: str | None = None
    flag: str | None = None
    metavar: str | None = None
    key: str | None = None
    bare: Any = None
    least: int | None = None
    parameter: Parameter = Parameter("_", Parameter.KEYWORD_ONLY)
    kinds: tuple[Any, ...] = ()

    @property
    def line(self) -> str:
        """One line about it."""
        return self.text or _description(self.key or "")

    @property
    def named(self) -> bool:
        """Whether it has values by name: its flag takes one of them."""
        return any(get_origin(kind) is Iterable for kind in self.kinds)

    @property
    def repeatable(self) -> bool:
        """Whether its flag may be given more than once."""
        return self.named or any(get_origin(kind) is Sequence for kind in self.kinds)

    def taken(self, value: object) -> Any:  # noqa: ANN401  of one of its types
        """A value that was given for it.

        Raises:
            CallRefused: it is of another type.
        """
        words = [word for kind in self.kinds for word in get_args(kind) if get_origin(kind) is Literal]
        try:
            own = taken(value, self.kinds)
            if self.least is None or own is None or own >= self.least:
                return own
        except (TypeError, ValueError, LookupError):
            pass
        near = nearest(value, words) if isinstance(value, str) else None
        expected = re.sub(r"Literal\[(.*?)\]", r"\1", self.parameter.annotation)
        expected += f" from {self.least} on" if self.least is not None else ""
        hint = f"Did you mean {option_text(self.parameter.name, near)}?" if near else None
        raise CallRefused(f"{option_text(self.parameter.name, value)}: expected {expected}", hint=hint)


class CallOptions(msgspec.Struct, frozen=True, kw_only=True):
    """Base of all options: what is made has values of the types of its fields, whatever was given for them.

    Raises:
        CallRefused: a value is of another type; names the option.
    """

    def __post_init__(self) -> None:
        for name, field in option_fields(type(self)).items():
            if (value := getattr(self, name)) is not field.parameter.default:
                force_setattr(self, name, field.taken(value))

    def given(self) -> dict[str, Any]:
        """The options that have another value than their default."""
        fields = option_fields(type(self))
        return {name: value for name in fields if (value := getattr(self, name)) is not fields[name].parameter.default}


class takes(Generic[P, O]):  # noqa: N801  a decorator
    """Lets a method or a function whose last parameter are options take each of them by name.

    Args:
        options: the Struct of the options, all of which become parameters; in the docstring, they are listed in the
            place of the line `options: ...`.
    """

    def __init__(self, options: Callable[P, O]) -> None:
        self._options = options

    @overload
    def __call__(self, call: Callable[[S, O], R]) -> Callable[Concatenate[S, P], R]: ...
    @overload
    def __call__(self, call: Callable[[S, T, O], R]) -> Callable[Concatenate[S, T, P], R]: ...
    def __call__(self, call: Callable[..., R]) -> Callable[..., R]:
        """The call with the options as parameters."""
        options, with_arguments = self._options, checked(call)
        assert isinstance(options, type)
        assert issubclass(options, CallOptions)
        fields = option_fields(options)
        *own, _ = signature(call).parameters.values()
        parameters = [*own, *(field.parameter for field in fields.values())]
        shown = signature(call).replace(parameters=sorted(parameters, key=lambda one: one.kind))

        @wraps(call)
        def refusing(*values: Any, **named: Any) -> R:  # noqa: ANN401  whatever is given
            given = _bound(call, shown, values, named)
            chosen = options(**{name: given.pop(name) for name in fields if name in given})
            return with_arguments(*given.values(), chosen)

        refusing.__signature__ = shown  # type: ignore[attr-defined]  # which the type of a function does not have
        lines = [f"\\1{name}: {field.line}\n" for name, field in fields.items()]
        refusing.__doc__ = re.sub(r"(?m)^( +)options: .*\n", "".join(lines), call.__doc__ or "")
        return refusing


def _bound(
    call: Callable[..., Any], shown: Signature, values: tuple[Any, ...], named: dict[str, Any]
) -> dict[str, Any]:
    """The arguments of a call by name.

    Raises:
        CallRefused: one is missing or misspelt.
    """
    try:
        return shown.bind(*values, **named).arguments
    except TypeError as error:
        near = next((one for name in named if (one := nearest(name, shown.parameters)) not in (None, *named)), None)
        hint = f"Did you mean `{near}`?" if near else None
        raise CallRefused(f"`{call.__qualname__}`: {error}", hint=hint) from error


_ARGUMENTS = {
    **{one.__name__: one for one in (bool, float, int, str)},
    "None": NoneType,
    "Sequence[str]": Sequence[str],
    "Mapping[str, Any]": Mapping[str, Any],
}
"""Types of arguments that `checked` knows, beside the names of the module; others are for the call itself to check."""


def checked(call: Callable[P, R]) -> Callable[P, R]:
    """Lets a public call refuse an argument of a wrong type, and a misspelt one, before it begins.

    Raises:
        CallRefused: names the argument.
    """

    @cache
    def known() -> tuple[Signature, dict[str, tuple[Any, ...]]]:  # at the first call: an import does not wait for it
        own = signature(call)
        types = {name: one for name, one in (call.__globals__ | _ARGUMENTS).items() if one is not Any}
        words = {one.name: str(one.annotation).split(" | ") for one in own.parameters.values()}
        return own, {
            name: tuple(types[word] for word in all_) for name, all_ in words.items() if types.keys() >= {*all_}
        }

    @wraps(call)
    def refusing(*values: P.args, **named: P.kwargs) -> R:
        own, kinds = known()
        given = _bound(call, own, values, named)
        for name in kinds.keys() & given.keys():
            parameter = own.parameters[name]
            for value in given[name] if parameter.kind is Parameter.VAR_POSITIONAL else (given[name],):
                try:
                    taken(value, kinds[name])
                except (TypeError, ValueError):
                    words = ", ".join(repr(word) for kind in kinds[name] for word in get_args(kind))
                    expected = words if "Literal" in str(kinds[name]) else parameter.annotation
                    raise CallRefused(f"{option_text(name, value)}: expected {expected}") from None
        return call(*values, **named)

    return refusing


@cache
def option_fields(options: type[CallOptions]) -> dict[str, Option]:
    """The options of a Struct, by name."""
    annotations: dict[str, Any] = {}
    for base in reversed(options.__mro__):
        annotations |= inspect.get_annotations(base, eval_str=True)
    fields = {}
    for name, default in zip(options.__struct_fields__, options.__struct_defaults__, strict=True):
        kind, option = annotations[name].__origin__, annotations[name].__metadata__[0]
        text = " | ".join("None" if one is NoneType else inspect.formatannotation(one) for one in kinds_of(kind))
        text = re.sub(r"\b(?:[a-z_]+\.)+(?=[A-Z])|'(?=MeshStatus|Event|Result|\], object)", "", text)
        by = Parameter.POSITIONAL_OR_KEYWORD if name in options.__match_args__ else Parameter.KEYWORD_ONLY
        parameter = Parameter(name, by, default=default, annotation=text)
        fields[name] = replace(option, parameter=parameter, kinds=kinds_of(kind))
    return fields


@cache
def _description(key: str) -> str:
    """What the configuration says about a key, as help: no full stop, and nothing about null, which no option takes."""
    section, _, name = key.partition(".")
    text: str = next(meta.description for meta in _hints(section)[name].__metadata__)
    return f"{text[0].lower()}{text[1:]}".partition("; null:")[0].removesuffix(".")


@cache
def _hints(section: str) -> dict[str, Any]:
    """The types of the keys of a section: evaluated once, because many options ask for it at start-up."""
    from .mesh import Config  # noqa: PLC0415  slow to import, and only for the help

    return get_type_hints(kinds_of(get_type_hints(Config)[section])[0], include_extras=True)
