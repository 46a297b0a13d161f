"""Writes the pages of the site into a folder, each where it is in the clone: `python docs/site_pages.py FOLDER`.

So a link of a page leads to the same place on a forge and on the site. Pages outside of `docs/` (README, CONTRIBUTING,
examples, bridges) are pages of the site, too, and a file or a folder that a page links to becomes a page that shows it.
`mkdocs.yml` says what becomes of the pages.
"""

from __future__ import annotations

import posixpath
import re
import shutil
import sys
from pathlib import Path

__all__ = ["site_pages"]

ROOT = Path(__file__).resolve().parents[1]
FOLDERS = ("bridges", "docs", "examples")
COPIED = {".css", ".onnx", ".png", ".svg"}
LANGUAGES = {".cc": "cpp", ".json": "json", ".py": "python", ".toml": "toml", ".yaml": "yaml"}

_FENCE = re.compile(r"^```.*?^```", re.MULTILINE | re.DOTALL)
_LINK = re.compile(r"(\]\()(?![a-z]+:|#)([^)#\s]+)((?:#[^)\s]*)?\))")


def main(folder: Path) -> None:
    """Write all pages, and what is shown or linked to as it is, into ``folder``; what was there is removed."""
    shutil.rmtree(folder, ignore_errors=True)
    files = {name: text.encode() for name, text in site_pages().items()}
    copied = (path for part in FOLDERS for path in (ROOT / part).rglob("*") if path.suffix in COPIED)
    files |= {_name(path): path.read_bytes() for path in copied}
    for name, content in files.items():
        file = folder / name
        file.parent.mkdir(parents=True, exist_ok=True)
        file.write_bytes(content)


def site_pages() -> dict[str, str]:
    """The text of each page of the site, by its name in the clone."""
    own = [*ROOT.glob("*.md"), *(page for folder in FOLDERS for page in (ROOT / folder).rglob("*.md"))]
    pages = {_name(page): page.read_text(encoding="utf-8") for page in sorted(own)}
    for page in [*pages]:
        pages[page] = _linked(page, pages)
    return pages


def _linked(page: str, pages: dict[str, str]) -> str:
    """A page whose links to files and folders lead to pages that show them; adds these pages to ``pages``."""
    folder = posixpath.dirname(page)

    def to_page(link: re.Match[str]) -> str:
        target = posixpath.normpath(posixpath.join(folder, link[2]))
        path = ROOT / target
        if target in pages or path.suffix in COPIED or not path.exists():
            return link[0]  # a link that leads nowhere is for the tests of pages to find
        shown = f"{target}/README.md" if path.is_dir() else f"{target}.md"
        if shown not in pages:
            pages[shown] = _folder(path, pages) if path.is_dir() else _listing(path)
        return link[1] + posixpath.relpath(shown, folder or ".") + link[3]

    listings = [*_FENCE.findall(pages[page]), ""]
    prose = [_LINK.sub(to_page, part) for part in _FENCE.split(pages[page])]
    return "".join(text for both in zip(prose, listings, strict=True) for text in both)


def _folder(folder: Path, pages: dict[str, str]) -> str:
    """A page that lists the files of a folder, which become pages, too."""
    lines = [f"# `{_name(folder)}/`", ""]
    for path in sorted(path for path in folder.iterdir() if path.is_file()):
        if path.suffix == ".md":
            title = path.read_text(encoding="utf-8").partition("\n")[0].removeprefix("# ")
            lines.append(f"* [{title}]({path.name})")
        else:
            pages.setdefault(f"{_name(path)}.md", _listing(path))
            lines.append(f"* [`{path.name}`]({path.name}.md)")
    return "\n".join([*lines, ""])


def _listing(path: Path) -> str:
    """A page that shows a file."""
    return f"# `{_name(path)}`\n\n````{LANGUAGES.get(path.suffix, 'text')}\n{path.read_text(encoding='utf-8')}\n````\n"


def _name(path: Path) -> str:
    return path.relative_to(ROOT).as_posix()


if __name__ == "__main__":
    main(Path(sys.argv[1]))
