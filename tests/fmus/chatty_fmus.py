"""FMUs that log 20 messages in each call, and at their end how many these were."""

from __future__ import annotations

from pathlib import Path

from tests.fmus.event_fmus import SOURCES, Version, event_source_fmu

__all__ = ["chatty_fmu"]

_AFTER = "if (!(instance->mode & allowed)) broken(function, mode_names[k]);\n"
_LOG = {
    2: "instance->logger(instance->environment, instance->name, fmi2Warning, category, format, said);",
    3: 'char text[64]; snprintf(text, 64, format, said); instance->log(instance->environment, fmi3Warning, "a", text);',
}
_SAY = """
    {
        static long said;
        const char *format = strstr(function, "Terminate") ? "%ld in all" : "iteration %ld", *category = "a";
        (void)category;
        ONCE
        for (k = strstr(function, "Free") ? 0 : strstr(function, "Terminate") ? 1 : 20; k > 0; k--) {
            LOG
            said++;
        }
    }
"""


def chatty_fmu(version: Version, folder: Path, only: str | None = None, once: str = "") -> Path:
    """Write one of FMI 2.0 or 3.0, with its sources only.

    Args:
        version: of FMI.
        folder: for the archive.
        only: the one kind that it declares.
        once: C that each call runs before the messages; `function` is the name of the function.
    """
    file = f"fmi{version}.c"
    code = (SOURCES / file).read_text(encoding="utf-8")
    assert _AFTER in code
    says = _SAY.replace("ONCE", once).replace("LOG", _LOG[version])
    code = "#include <pthread.h>\n#include <stdio.h>\n" + code.replace(_AFTER, _AFTER + says, 1)
    return event_source_fmu(
        "Stairs", version, folder / f"chatty{version}.fmu", add={f"sources/{file}": code}, only=only
    )
