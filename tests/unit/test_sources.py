"""FMUs that bring sources instead of a binary: compiled once, into the cache, or told why not."""

from __future__ import annotations

import math
import re
import shutil
import subprocess
import sys
import zipfile
from collections.abc import Mapping
from contextlib import closing
from pathlib import Path
from typing import Literal

import pytest
import yaml

from fmu_mesh.cli.main import main
from fmu_mesh.errors import LoadFailed
from fmu_mesh.files import cache_folder
from fmu_mesh.instances.fmi.archive.reading import read_description
from fmu_mesh.instances.fmi.archive.sources import extract
from fmu_mesh.instances.fmi.opening import open_instance
from fmu_mesh.variables.model_description import Kind
from tests.fmus import event_fmus
from tests.fmus.event_fmus import Version, event_source_fmu
from tests.fmus.helpers import FMUS, NO_COMPILER, find_fmu
from tests.fmus.packing import repacked, unpacked, without_binaries

pytestmark = pytest.mark.skipif(NO_COMPILER is not None, reason=str(NO_COMPILER))


@pytest.fixture(autouse=True)
def cache(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A cache of the test's own."""
    monkeypatch.setenv("FMU_MESH_CACHE_DIR", str(tmp_path / "cache"))
    return tmp_path / "cache"


def libraries(cache: Path) -> list[Path]:
    return sorted(cache.rglob("*.so"))


def config_with(fmu: Path) -> Path:
    file = fmu.parent / "mesh.yaml"
    content = {
        "mesh": "one",
        "simulation": {"stop_time": 1, "step_size": 0.1},
        "instances": {"gain": {"fmu": fmu.name, "start_values": {"u": 3.0, "k": 0.1}}},
        "record": {"file": "one.csv"},
    }
    file.write_text(yaml.safe_dump(content), encoding="utf-8")
    return file


def test_a_source_fmu_is_compiled_once_told_and_gives_the_same_result(
    tmp_path: Path, cache: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    kept = tmp_path / "kept.fmu"
    shutil.copy(FMUS / "Gain.fmu", kept)
    assert main(["launch", "--local", str(config_with(kept))]) == 0
    expected = (tmp_path / "one.csv").read_bytes()
    config = config_with(without_binaries(tmp_path / "sources.fmu"))
    capsys.readouterr()

    assert main(["launch", "--local", str(config)]) == 0

    assert "sources.fmu' has no binary for this platform (linux64): compiling its sources" in capsys.readouterr().err
    assert (tmp_path / "one.csv").read_bytes() == expected
    (library,) = libraries(cache)
    assert library.name == "Gain.so"
    made = library.stat().st_mtime_ns
    assert main(["launch", "--local", str(config)]) == 0
    assert "compiling" not in capsys.readouterr().err
    assert [one.stat().st_mtime_ns for one in libraries(cache)] == [made]
    assert [one.name for one in library.parent.iterdir()] == ["Gain.so"]


def test_other_sources_are_compiled_anew(tmp_path: Path, cache: Path) -> None:
    extract(without_binaries(tmp_path / "first.fmu"), tmp_path)
    changed = repacked(
        tmp_path / "second.fmu", source=tmp_path / "first.fmu", add={"sources/extra.h": b"/* another file */"}
    )

    extract(changed, tmp_path)

    assert len(libraries(cache)) == 2


def test_unpacked_source_fmu_is_compiled_into_cache_and_not_into_its_folder(tmp_path: Path, cache: Path) -> None:
    source = unpacked(tmp_path / "gain", source=without_binaries(tmp_path / "sources.fmu"))
    before = sorted(source.rglob("*"))

    folder = extract(source, tmp_path / "parent")

    assert (folder / "binaries/linux64/Gain.so").is_file()
    assert sorted(source.rglob("*")) == before
    assert len(libraries(cache)) == 1


def test_an_unpacked_folder_runs_and_stays_as_it_is(tmp_path: Path) -> None:
    source = unpacked(tmp_path / "gain")
    before = {path: path.stat().st_mtime_ns for path in source.rglob("*")}

    assert main(["launch", "--local", str(config_with(source))]) == 0

    assert (tmp_path / "one.csv").read_text().splitlines()[-1] == "1.0,0.30000000000000004"
    assert {path: path.stat().st_mtime_ns for path in source.rglob("*")} == before


def test_functions_with_a_prefix_get_their_plain_names_in_the_library(tmp_path: Path) -> None:
    """Sources may define FMI2_FUNCTION_PREFIX, for linking them statically (FMI 2.0, 2.1.1)."""
    name = "sources/fmi2Functions.h"
    sources = without_binaries(tmp_path / "sources.fmu")
    with zipfile.ZipFile(sources) as archive:
        header = b"#define FMI2_FUNCTION_PREFIX Gain_\n" + archive.read(name)
    fmu = repacked(tmp_path / "prefixed.fmu", source=sources, keep=lambda one: one != name, add={name: header})

    assert main(["launch", "--local", str(config_with(fmu))]) == 0

    assert (tmp_path / "one.csv").read_text().splitlines()[-1] == "1.0,0.30000000000000004"


def with_gain_of(text: str, target: Path, add: Mapping[str, str] = {}) -> Path:
    """The source FMU of `Gain`, with ``text`` before its first line, and `gain()` in the place of its parameter."""
    sources = without_binaries(target.with_name("sources.fmu"))
    with zipfile.ZipFile(sources) as archive:
        source = archive.read("sources/Gain.c").decode()
    assert "s->k * s->u" in source
    changed = text + source.replace("s->k * s->u", "gain() * s->u")
    members: dict[str | zipfile.ZipInfo, bytes] = {"sources/Gain.c": changed.encode()}
    members.update({name: content.encode() for name, content in add.items()})
    return repacked(target, source=sources, keep=lambda name: name != "sources/Gain.c", add=members)


STRTOD_L = """#define _GNU_SOURCE
#include <locale.h>
#include <stdlib.h>
static double gain(void) { return strtod_l("2.5", NULL, newlocale(LC_ALL_MASK, "C", NULL)); }
"""


def test_a_feature_macro_in_the_first_line_of_a_source_counts(tmp_path: Path) -> None:
    fmu = with_gain_of(STRTOD_L, tmp_path / "gain.fmu")

    assert main(["launch", "--local", str(config_with(fmu))]) == 0

    assert (tmp_path / "one.csv").read_text().splitlines()[-1] == "1.0,7.5"


@pytest.mark.parametrize(
    ("text", "says"),
    [
        (STRTOD_L.replace("#define _GNU_SOURCE\n", ""), "strtod_l.* C would take a function without a declaration"),
        ("static double gain(void) { char *p = 5; return *p; }\n", "do not compile: .*from .int. "),
    ],
    ids=["a function without a declaration", "an int as a pointer"],
)
def test_sources_that_would_compute_something_else_do_not_compile(text: str, says: str, tmp_path: Path) -> None:
    fmu = with_gain_of(text, tmp_path / "gain.fmu")

    with pytest.raises(LoadFailed) as caught:
        extract(fmu, tmp_path / "parent")

    assert re.search(says, str(caught.value))


def test_old_c_still_compiles(tmp_path: Path) -> None:
    text = "static three() { return 3; }\nstatic double gain(void) { double d = three(); int *p = &d; return *p; }\n"

    assert (extract(with_gain_of(text, tmp_path / "gain.fmu"), tmp_path / "p") / "binaries/linux64/Gain.so").is_file()


def test_headers_in_folders_below_the_sources_are_found(tmp_path: Path) -> None:
    included = '#include "factor.h"\n#include <offset.h>\n#include <stdio.h>\n'
    text = included + "static double gain(void) { return FACTOR + OFFSET + EOF; }\n"
    headers = {
        "sources/deep/er/factor.h": "#define FACTOR 2.5\n",
        "sources/other/offset.h": "#define OFFSET 1\n",
        "sources/other/stdio.h": "#error this is not that of the system\n",
    }
    fmu = with_gain_of(text, tmp_path / "gain.fmu", headers)

    assert main(["launch", "--local", str(config_with(fmu))]) == 0

    assert (tmp_path / "one.csv").read_text().splitlines()[-1] == "1.0,7.5"


def test_without_a_list_all_sources_at_the_root_are_compiled(tmp_path: Path) -> None:
    def without_list(text: str) -> str:
        start, end = text.index("<SourceFiles>"), text.index("</SourceFiles>") + len("</SourceFiles>")
        return text[:start] + text[end:]

    sources = without_binaries(tmp_path / "sources.fmu")
    path = repacked(tmp_path / "unlisted.fmu", source=sources, description=without_list)

    assert (extract(path, tmp_path / "parent") / "binaries/linux64/Gain.so").is_file()


@pytest.mark.parametrize(
    "listed",
    [
        '<File name="./"/><File name="Gain.c"/>',
        '<File name="./Gain.c"/>',
        '<File name="."/><File name="more"/><File name="more/"/><File name="more/../Gain.c"/><File name="Gain.c"/>',
    ],
    ids=["its own folder, too", "a dot before the name", "folders and a detour"],
)
def test_sources_are_listed_as_openmodelica_does_it(listed: str, tmp_path: Path) -> None:
    sources = without_binaries(tmp_path / "sources.fmu")
    path = repacked(
        tmp_path / "listed.fmu",
        source=sources,
        description=lambda text: text.replace('<File name="Gain.c"/>', listed),
        add={"sources/more/unused.h": b""},
    )
    with zipfile.ZipFile(path) as archive:
        assert listed in archive.read("modelDescription.xml").decode()

    assert (extract(path, tmp_path / "parent") / "binaries/linux64/Gain.so").is_file()


@pytest.mark.parametrize(
    ("change", "says"),
    [
        (('<File name="Gain.c"/>', '<File name="Missing.c"/>'), "lists the source 'Missing.c', but does not contain"),
        (('<File name="Gain.c"/>', '<File name="../../x.c"/>'), "lists a source outside its own folder: '../../x.c'"),
        (('<File name="Gain.c"/>', '<File name="a/../../x.c"/>'), "lists a source outside its own folder: 'a/../../x"),
        (('<File name="Gain.c"/>', ""), "do not compile: .*model"),
    ],
    ids=["a missing file", "a file outside", "a file outside on a detour", "an undefined symbol"],
)
def test_sources_that_do_not_compile_are_told_with_reason_and_leave_nothing(
    change: tuple[str, str], says: str, tmp_path: Path, cache: Path
) -> None:
    sources = without_binaries(tmp_path / "sources.fmu")
    path = repacked(tmp_path / "bad.fmu", source=sources, description=lambda text: text.replace(*change))

    with pytest.raises(LoadFailed, match=says):
        extract(path, tmp_path / "parent")

    assert list((tmp_path / "parent").glob("*")) == []
    assert libraries(cache) == []


def test_without_a_compiler_check_refuses_with_the_ways_out(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setenv("CC", "no-such-compiler")
    config = config_with(without_binaries(tmp_path / "sources.fmu"))

    assert main(["check", str(config)]) == 2

    said = capsys.readouterr().err
    assert "mesh.yaml:" in said
    assert "instances.gain.fmu" in said
    assert "no binary for this platform (linux64) but sources, and there is no compiler" in said
    assert "no-such-compiler" in said
    assert "$CC" in said


# ---- the kind that runs


def two_libraries(text: str) -> str:
    """A description whose kinds have libraries of their own."""
    text = text.replace('<ModelExchange modelIdentifier="Ball"', '<ModelExchange modelIdentifier="Ball_me"')
    return text.replace('<CoSimulation modelIdentifier="Ball"', '<CoSimulation modelIdentifier="Ball_cs"')


def bounces(fmu: Path, kind: Literal["auto"] | Kind = "auto") -> float:
    """Runs a ball for 2 s and returns the time of its last bounce in s."""
    config = fmu.parent / "ball.yaml"
    content = {
        "mesh": "ball",
        "simulation": {"stop_time": 2, "step_size": 0.1},
        "instances": {"ball": {"fmu": fmu.name, "kind": kind}},
        "record": {"file": "ball.csv", "variables": ["ball.last_bounce"]},
    }
    config.write_text(yaml.safe_dump(content), encoding="utf-8")
    assert main(["launch", "--local", str(config)]) == 0
    return float((fmu.parent / "ball.csv").read_text().splitlines()[-1].split(",")[1])


LAST_BOUNCE = math.sqrt(2 / 9.81) * (1 + 2 * (0.7 + 0.49 + 0.343))


@pytest.mark.parametrize("version", [1, 2, 3])
def test_a_source_fmu_for_model_exchange_only_is_compiled_and_runs(version: Version, tmp_path: Path) -> None:
    fmu = event_source_fmu("Ball", version, tmp_path / "ball.fmu", only=None if version == 1 else "model_exchange")

    assert bounces(fmu) == pytest.approx(LAST_BOUNCE, abs=1e-5)


@pytest.mark.parametrize("name", ["AllTypes1", "AllTypes3"])
def test_source_fmu_for_co_simulation_is_compiled_in_fmi_1_and_3(name: str, tmp_path: Path) -> None:
    fmu = without_binaries(tmp_path / "sources.fmu", source=find_fmu(name, tmp_path))
    description = read_description(fmu)

    with closing(open_instance(fmu, "m", description, tmp_path)) as instance:
        instance.enter_initialization(0.0, 1.0, {})
        instance.exit_initialization()


@pytest.mark.parametrize("version", [2, 3])
@pytest.mark.parametrize(("kind", "library"), [("model_exchange", "Ball_me.so"), ("co_simulation", "Ball_cs.so")])
def test_of_two_kinds_with_libraries_that_of_kind_that_runs_is_compiled(
    kind: Kind, library: str, version: Version, tmp_path: Path, cache: Path
) -> None:
    fmu = event_source_fmu("Ball", version, tmp_path / "ball.fmu", two_libraries)

    assert bounces(fmu, kind) == pytest.approx(LAST_BOUNCE, abs=1e-5)

    assert [one.name for one in libraries(cache)] == [library]


def test_each_kind_is_compiled_from_files_that_fmi_2_lists_for_it(tmp_path: Path) -> None:
    files = "".join(f'<File name="{name}"/>' for name in ("fmi2.c", "stepping.c", "Ball.c"))
    lists = {"ModelExchange": files, "CoSimulation": '<File name="other.c"/>'}

    def listed(text: str) -> str:
        for kind, names in lists.items():
            text = re.sub(f"(<{kind}[^>]*)/>", rf"\1><SourceFiles>{names}</SourceFiles></{kind}>", text)
        return text

    fmu = event_source_fmu("Ball", 2, tmp_path / "ball.fmu", listed, {"sources/other.c": "#error this is another kind"})

    assert bounces(fmu, "model_exchange") == pytest.approx(LAST_BOUNCE, abs=1e-5)
    with pytest.raises(LoadFailed, match=r"do not compile: .*this is another kind"):
        extract(fmu, tmp_path / "parent", model=read_description(fmu, kind="co_simulation"))


def test_of_the_build_configurations_that_of_the_running_kind_is_taken(tmp_path: Path, cache: Path) -> None:
    def configuration(identifier: str, *files: str) -> str:
        names = "".join(f'<SourceFile name="{name}"/>' for name in files)
        definition = f'<PreprocessorDefinition name="MODEL_IDENTIFIER" value="{identifier}"/>'
        return (
            f'<BuildConfiguration modelIdentifier="{identifier}"><SourceFileSet language="C99">{names}{definition}'
            "</SourceFileSet></BuildConfiguration>"
        )

    ours = configuration("Ball_me", "fmi3.c", "stepping.c", "Ball.c")
    build = f'<fmiBuildDescription fmiVersion="3.0">{configuration("Ball_cs", "no.c")}{ours}</fmiBuildDescription>'
    fmu = event_source_fmu(
        "Ball", 3, tmp_path / "ball.fmu", two_libraries, {"sources/buildDescription.xml": build, "sources/no.c": "!"}
    )

    assert bounces(fmu, "model_exchange") == pytest.approx(LAST_BOUNCE, abs=1e-5)
    assert [one.name for one in libraries(cache)] == ["Ball_me.so"]


def test_a_library_of_the_other_kind_is_no_reason_not_to_compile(tmp_path: Path, cache: Path) -> None:
    add = {"binaries/linux64/Ball_cs.so": "not looked at"}
    fmu = event_source_fmu("Ball", 2, tmp_path / "ball.fmu", two_libraries, add)

    assert bounces(fmu, "model_exchange") == pytest.approx(LAST_BOUNCE, abs=1e-5)

    assert [one.name for one in libraries(cache)] == ["Ball_me.so"]


def test_a_library_of_other_kind_without_sources_is_told_with_way_out(tmp_path: Path) -> None:
    sources = event_source_fmu("Ball", 2, tmp_path / "sources.fmu", two_libraries)
    library: dict[str | zipfile.ZipInfo, bytes] = {"binaries/linux64/Ball_cs.so": b"not looked at"}
    fmu = repacked(tmp_path / "ball.fmu", source=sources, keep=lambda name: "sources/" not in name, add=library)

    with pytest.raises(LoadFailed, match=r"has only 'binaries/linux64/Ball_cs.so', the library of its") as caught:
        read_description(fmu, kind="model_exchange")

    assert caught.value.hint == "Leave `kind` to the other one, or export it with both libraries."


def test_sources_of_fmi_1_need_not_bring_the_headers_of_the_standard(tmp_path: Path) -> None:
    text = (Path(event_fmus.SOURCES) / "fmi1.c").read_text(encoding="utf-8")
    text = text.replace("fmi1Functions.h", "fmiModelFunctions.h").replace("fmi1", "fmi")
    text = text.replace("#define EXPORT(name) JOIN(MODEL_IDENTIFIER, name)", "#define EXPORT(name) name")
    fmu = event_source_fmu("Ball", 1, tmp_path / "ball.fmu", add={"sources/fmi1.c": text})

    assert bounces(fmu) == pytest.approx(LAST_BOUNCE, abs=1e-5)


def test_two_processes_at_once_compile_without_harm(tmp_path: Path, cache: Path) -> None:
    path = without_binaries(tmp_path / "sources.fmu")
    module = "fmu_mesh.instances.fmi.archive.sources"
    program = f"import sys, pathlib as p; from {module} import extract; extract(*map(p.Path, sys.argv[1:]))"
    command = [sys.executable, "-c", program, str(path), str(tmp_path / "parent")]

    processes = [subprocess.Popen(command) for _ in range(2)]

    assert [process.wait(50) for process in processes] == [0, 0]
    (library,) = libraries(cache)
    copies = sorted(tmp_path.glob("parent/*/binaries/linux64/Gain.so"))
    assert [copy.read_bytes() for copy in copies] == [library.read_bytes()] * 2


@pytest.mark.parametrize(
    ("others", "ways_out"),
    [
        (["win64", "aarch64-darwin"], "; `apt install wine` lets it run under Wine."),
        (["win32"], ", or for 64-bit Windows, to run under Wine: libraries for 32-bit Windows are not supported yet."),
        (["aarch64-darwin"], "."),
    ],
)
def test_an_fmu_for_another_platform_without_sources_is_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, others: list[str], ways_out: str
) -> None:
    monkeypatch.setenv("PATH", "/nonexistent")  # without Wine
    path = repacked(
        tmp_path / "elsewhere.fmu",
        keep=lambda name: name == "modelDescription.xml",
        add={f"binaries/{name}/Gain.{'dll' if 'win' in name[:3] else 'dylib'}": b"" for name in others},
    )

    with pytest.raises(LoadFailed) as refused:
        read_description(path)

    assert f"no binary for this platform (linux64); it has: {', '.join(sorted(others))}." in refused.value.message
    assert refused.value.hint == f"Export it for this platform, or with its sources{ways_out}"


@pytest.mark.parametrize(
    ("environment", "expected"),
    [
        ({"FMU_MESH_CACHE_DIR": "/one", "XDG_CACHE_HOME": "/two"}, "/one"),
        ({"XDG_CACHE_HOME": "/two"}, "/two/fmu_mesh"),
        ({"XDG_CACHE_HOME": "", "HOME": "/three"}, "/three/.cache/fmu_mesh"),
        ({"HOME": "/three"}, "/three/.cache/fmu_mesh"),
    ],
)
def test_the_cache_is_where_the_environment_says(
    environment: dict[str, str], expected: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    for name in ("FMU_MESH_CACHE_DIR", "XDG_CACHE_HOME"):
        monkeypatch.delenv(name, raising=False)
    for name, value in environment.items():
        monkeypatch.setenv(name, value)
    assert cache_folder() == Path(expected)
