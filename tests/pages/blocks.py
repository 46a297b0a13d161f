"""The blocks of a page: what a reader copies, with the note that an HTML comment before a block gives to the tests.

Readers do not see the notes. There are four:

    <!-- not run: REASON -->    the block is not run; `test_pages.py` lists all of these
    <!-- needs: MODULE -->      it is run where this Python module, or this program, is installed
    <!-- meanwhile -->          its command goes on while the blocks after it are run
    <!-- file: NAME -->         the block is a file that commands of any page name
"""

from __future__ import annotations

import re
from pathlib import Path

import msgspec
from markdown_it import MarkdownIt

__all__ = ["PAGES", "ROOT", "Block", "Command", "blocks_of"]

ROOT = Path(__file__).resolve().parents[2]
PAGES = [
    *sorted(ROOT.glob("*.md")),
    *(page for folder in ("bridges", "docs", "examples") for page in sorted((ROOT / folder).rglob("*.md"))),
]

LANGUAGES = {"sh", "console", "yaml", "python", "json", "xml", "text"}
"""What a block may be. An indented block whose first line begins with `$` is `console`, any other one is `text`."""

_NOTE = re.compile(r"<!-- (not run|needs|meanwhile|file)(?:: (.+?))? -->\s*", re.DOTALL)


class Command(msgspec.Struct, frozen=True):
    """A command of a shell block, and the lines that the page shows as its output."""

    line: str
    output: tuple[str, ...] = ()


class Block(msgspec.Struct, frozen=True):
    """One block of a page: its place, what it is, its text, and the note before it."""

    place: str
    language: str
    text: str
    note: str | None = None
    detail: str = ""

    def commands(self, shown: str | None) -> list[Command]:
        """The commands of a shell block.

        Args:
            shown: what the page shows after an `sh` block: the output of its last command. In a `console` block
                commands begin with `$`, and the first line of their output follows, or
                an error; what else is shown there depends on the moment.
        """
        lines = re.sub(r"\\\n", "", self.text).splitlines()
        if self.language == "sh":
            commands = [Command(re.sub(r"\s+#.*", "", line)) for line in lines if line.strip()]
            return [*commands[:-1], Command(commands[-1].line, tuple((shown or "").splitlines()))]
        commands = []
        for line in filter(str.strip, lines):
            if line.startswith("$ "):
                commands.append(Command(line.removeprefix("$ ")))
            elif not commands[-1].output or line.startswith("fmu-mesh: "):
                commands[-1] = Command(commands[-1].line, (*commands[-1].output, line))
        return commands


def blocks_of(page: Path) -> list[Block]:
    """All blocks of a page, in order."""
    blocks = []
    note: tuple[str | None, str] = (None, "")
    name = page.relative_to(ROOT)
    for token in MarkdownIt().parse(page.read_text(encoding="utf-8")):
        if token.type == "html_block" and (found := _NOTE.fullmatch(token.content)):
            note = (found[1], " ".join((found[2] or "").split()))
            continue
        if token.type in {"fence", "code_block"}:
            assert token.map is not None
            indented = "console" if token.content.startswith("$ ") else "text"
            language = token.info if token.type == "fence" else indented
            blocks.append(Block(f"{name}:{token.map[0] + 1}", language, token.content, *note))
        note = (None, "")
    return blocks
