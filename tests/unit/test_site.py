"""The site has all pages, and its reference all public names; `make docs` finds links that lead nowhere."""

from __future__ import annotations

import importlib
import importlib.util
import inspect
import re
from collections import Counter
from collections.abc import Iterator
from pathlib import Path
from types import ModuleType

import pytest
import yaml

import fmu_mesh

ROOT = Path(__file__).resolve().parents[2]
REFERENCE = "docs/reference"
DIRECTIVE = re.compile(r"^::: (\S+)\n((?: {4}.*\n)*)", re.MULTILINE)


OF_OTHERS = {
    *("Any", "Callable", "ClassVar", "Iterator", "Literal", "Mapping", "None", "Self", "Sequence"),
    *("DataFrame", "Event", "Figure", "ForwardRef", "NDArray", "Path", "Rows"),
}
"""Names in annotations that are no types of ours."""


def loaded(name: str) -> ModuleType:
    """A module of the folder `docs`."""
    specification = importlib.util.spec_from_file_location(name, ROOT / "docs" / f"{name}.py")
    assert specification is not None
    assert specification.loader is not None
    module = importlib.util.module_from_spec(specification)
    specification.loader.exec_module(module)
    return module


@pytest.fixture(scope="module")
def site() -> ModuleType:
    return loaded("site_pages")


def navigation(entry: object) -> Iterator[str]:
    """The pages of an entry of the navigation."""
    if isinstance(entry, str):
        yield entry
    elif isinstance(entry, dict):
        for part in entry.values():
            yield from navigation(part)
    elif isinstance(entry, list):
        for part in entry:
            yield from navigation(part)


def described() -> Counter[str]:
    """How often the reference describes each name."""
    names: Counter[str] = Counter()
    for page in (ROOT / REFERENCE).glob("*.md"):
        for name, options in DIRECTIVE.findall(page.read_text(encoding="utf-8")):
            whole = (yaml.safe_load(options) or {}).get("options", {}).get("members") is True
            names.update(importlib.import_module(name).__all__ if whole else [name.rpartition(".")[2]])
    return names


def test_the_navigation_has_every_page_once() -> None:
    pages = [
        *ROOT.glob("*.md"),
        *(page for part in ("bridges", "docs", "examples") for page in (ROOT / part).rglob("*.md")),
    ]
    entries = Counter(navigation(yaml.safe_load((ROOT / "mkdocs.yml").read_text(encoding="utf-8"))["nav"]))

    assert entries == Counter(page.relative_to(ROOT).as_posix() for page in pages), "see `nav` in mkdocs.yml"


def test_the_reference_describes_every_public_name_once() -> None:
    names = described()

    missing = [name for name in fmu_mesh.__all__ if name not in names and not name.startswith("__")]
    assert missing == [], f"add `::: fmu_mesh.NAME` to a page of {REFERENCE}"
    assert [name for name, times in names.items() if times > 1] == []


def returned_types() -> dict[str, str]:
    """The classes of ours that public calls return and public objects have, by name, and one place of each."""
    found: dict[str, str] = {}
    for offered in (getattr(fmu_mesh, name) for name in fmu_mesh.__all__):
        members = {"": offered, **(vars(offered) if inspect.isclass(offered) else {})}
        for name, member in members.items():
            own = member.fget if isinstance(member, property) else getattr(member, "__func__", member)
            if not name.startswith("_") and inspect.isfunction(own):
                words = str(inspect.unwrap(own).__annotations__.get("return", ""))
                found |= dict.fromkeys(re.findall(r"\b[A-Z]\w+", words), own.__qualname__)
        if inspect.isclass(offered):
            own_fields = inspect.get_annotations(offered).items()
            words = " ".join(str(annotation) for name, annotation in own_fields if not name.startswith("_"))
            found |= dict.fromkeys(re.findall(r"\b[A-Z]\w+", words), offered.__name__)
    return {name: place for name, place in found.items() if name not in OF_OTHERS}


def test_the_reference_describes_every_type_that_a_public_call_returns() -> None:
    names = described()

    assert {name: place for name, place in returned_types().items() if name not in names} == {}


def test_a_link_to_file_or_folder_leads_to_page_that_shows_it(site: ModuleType) -> None:
    pages = site.site_pages()

    assert "](configs/README.md)" in pages["README.md"]
    assert "* [`cycle2.yaml`](cycle2.yaml.md)" in pages["configs/README.md"]
    assert (ROOT / "configs/cycle2.yaml").read_text(encoding="utf-8") in pages["configs/cycle2.yaml.md"]
    assert "* [CartPole](CartPole.md)" in pages["docs/models/README.md"]
    assert "| [0001](0001-" in pages["docs/adr/README.md"]


def test_a_page_of_the_site_differs_from_its_source_in_links_only(site: ModuleType) -> None:
    def without_links(text: str) -> str:
        return re.sub(r"\]\([^)]*\)", "]()", text)

    pages = site.site_pages()

    for page in ROOT.glob("docs/**/*.md"):
        source = page.read_text(encoding="utf-8")
        assert without_links(pages[page.relative_to(ROOT).as_posix()]) == without_links(source)


def test_no_listing_of_a_page_is_changed(site: ModuleType) -> None:
    fences = re.compile(r"^```.*?^```", re.MULTILINE | re.DOTALL)
    source = (ROOT / "README.md").read_text(encoding="utf-8")

    assert fences.findall(site.site_pages()["README.md"]) == fences.findall(source)
