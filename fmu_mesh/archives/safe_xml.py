"""XML of other people, parsed without reading other files and without expanding entities."""

from __future__ import annotations

from typing import Any

from lxml import etree

from ..errors import LoadFailed

__all__ = ["safe_xml", "syntax_error"]

_LIMITS = "elements are nested more than 255 deep, or a tag, an attribute or a text has more than 10 million bytes"


def safe_xml(data: bytes, what: str) -> Any:  # noqa: ANN401 lxml ships no types
    """Parse ``data``, which errors call ``what``, and return the root element.

    A document type declaration is refused before it is read, because it can declare entities that expand without end
    or read other files. No document of FMI, SSP or SDF needs one.

    Raises:
        LoadFailed: there is a document type, or it is not well-formed XML.
    """
    try:
        # Two passes: a parser target gets the declaration before lxml acts on it, but it builds no tree.
        etree.fromstring(data, _parser(target=_NoDocumentType()))
        return etree.fromstring(data, _parser())
    except _DocumentTypeError as error:
        raise LoadFailed(
            f"{what} declares a document type, with which XML can expand without limit and read other files.",
            hint="No document of FMI, SSP or SDF needs one: remove its <!DOCTYPE>.",
        ) from error
    except etree.XMLSyntaxError as error:
        raise LoadFailed(f"{what} cannot be read: {syntax_error(error)}") from error


def syntax_error(error: etree.XMLSyntaxError) -> str:
    """In words, what is wrong with XML; of the limits of the parser it does not name its own options."""
    return f"{_LIMITS}, line {error.lineno}" if error.code == etree.ErrorTypes.ERR_RESOURCE_LIMIT else str(error.msg)


class _DocumentTypeError(Exception):
    """The document has a document type declaration."""


class _NoDocumentType:
    """A parser target that only looks for a document type declaration."""

    def doctype(self, *_declared: str | None) -> None:
        raise _DocumentTypeError

    def close(self) -> None:
        """The document has no such declaration."""


def _parser(**options: object) -> Any:  # noqa: ANN401 lxml ships no types
    return etree.XMLParser(
        resolve_entities=False, no_network=True, load_dtd=False, dtd_validation=False, huge_tree=False, **options
    )
