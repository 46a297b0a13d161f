"""Checks the subject of a commit: what it changes, as a command, in one line of `git log --oneline`.

A hook of `.pre-commit-config.yaml` calls it with the file of the message: ``python -m tests.commit_subject FILE``.
"""

from __future__ import annotations

import re
import sys
from pathlib import Path

__all__ = ["MOST_LETTERS", "problems_of"]

MOST_LETTERS = 72
"""What `git log --oneline` and forges show without cutting it off."""

# A subject says what happens to the code when the commit is applied: "Read CSV in blocks". A dictionary of verbs would
# refuse good ones, so only the forms that are not a command are found, by their endings. These words have such an
# ending and are commands.
_COMMANDS = re.compile("Bias|Bring|Embed|Exceed|Feed|Focus|Need|Proceed|Ring|Seed|Shed|Speed|Succeed")
_ENDINGS = re.compile(r"\w+(ed|ing|[^s]s)")
_NO_VERBS = re.compile("A|An|The|It|This|That|What|When|Where|Which|Who|Some|All|No|More|Now")


def problems_of(subject: str) -> list[str]:
    """What is wrong with the subject of a commit."""
    if re.match(r"(Merge|Revert) |(fixup|squash|amend)! ", subject):  # git has written it
        return []
    found = []
    if len(subject) > MOST_LETTERS:
        found.append(f"it has {len(subject)} characters; at most {MOST_LETTERS}")
    if re.search(r"\bwip\b", subject, re.IGNORECASE):
        found.append("say what changes instead of 'wip'")
    first = subject.partition(" ")[0]
    if not re.fullmatch(r"[A-Z][\w-]*", first):
        found.append("begin with a verb and a capital letter, without a prefix")
    elif _NO_VERBS.fullmatch(first) or (_ENDINGS.fullmatch(first) and not _COMMANDS.fullmatch(first)):
        found.append(f"begin with a command, such as 'Read' or 'Fix', not with '{first}'")
    if subject.endswith("."):
        found.append("leave out the full stop")
    return found


def main() -> None:
    """Check the message in the file that git names."""
    lines = Path(sys.argv[1]).read_text(encoding="utf-8").splitlines()
    subject = next((line for line in lines if line.strip() and not line.startswith("#")), "")
    if found := problems_of(subject):
        sys.exit(f"subject of the commit: {subject!r}\n" + "\n".join(f"  * {problem}" for problem in found))


if __name__ == "__main__":
    main()
