"""Packages that are damaged, hostile, or only unusual: what can be read is read, and the rest is refused clearly."""

from __future__ import annotations

import zipfile
from collections.abc import Callable
from pathlib import Path

import pytest

import fmu_mesh
from tests.ssp.bad_packages import GOOD
from tests.ssp.packages import Files, write_package

SSD = "SystemStructure.ssd"
TEXT = str(GOOD[SSD])
WRONG = TEXT.replace('implementation="CoSimulation"', 'implementation="Coupled"')
LINE = WRONG.count("\n", 0, WRONG.index("Coupled")) + 1


def edited(content: str | bytes, **others: str | bytes) -> Files:
    return {**GOOD, SSD: content, **others}


def utf_16(text: str) -> bytes:
    return text.replace('encoding="UTF-8"', 'encoding="UTF-16"').encode("utf-16")


def latin_1(text: str) -> bytes:
    return text.replace('encoding="UTF-8"', 'encoding="ISO-8859-1"').encode("latin-1")


WRITTEN: dict[str, Callable[[str], str | bytes]] = {
    "CRLF": lambda text: text.replace("\n", "\r\n"),
    "UTF-16": utf_16,
    "Latin-1": latin_1,
    "a byte order mark": lambda text: "\ufeff" + text,
    "comments and processing instructions": lambda text: text.replace(">\n", "><!-- c --><?p i?>\n"),
    "attributes of other namespaces": lambda text: text.replace('name="good"', 'name="good" xml:base="urn:x"', 1),
}


@pytest.mark.parametrize("way", WRITTEN)
def test_document_is_read_however_it_is_written_and_its_lines_are_known(way: str, tmp_path: Path) -> None:
    good = write_package(tmp_path / "good.ssp", edited(WRITTEN[way](TEXT)))
    wrong = write_package(tmp_path / "wrong.ssp", edited(WRITTEN[way](WRONG)))

    assert fmu_mesh.load(good).check()
    [finding] = fmu_mesh.load(wrong).check().findings
    assert (finding.line, "'Coupled'" in finding.found) == (LINE, True)


@pytest.mark.parametrize("way", ["CRLF", "UTF-16", "Latin-1"])
def test_the_lines_of_a_document_with_more_than_65535_lines_are_right(way: str, tmp_path: Path) -> None:
    many = WRONG.replace("<ssd:Elements>\n", "<ssd:Elements>" + "\n" * 70_000, 1)
    path = write_package(tmp_path / "long.ssp", edited(WRITTEN[way](many)))

    [finding] = fmu_mesh.load(path).check().findings

    assert finding.line == LINE + 70_000 - 1


def test_the_lines_of_many_elements_are_right(tmp_path: Path) -> None:
    connector = '<ssd:Connector\nname="c{}"\nkind="output">\n<ssc:Real/></ssd:Connector>\n'
    many = "".join(connector.format(number) for number in range(20_000))
    long = WRONG.replace('<ssd:Connector name="out" ', f'{many}<ssd:Connector name="out" ', 1)
    path = write_package(tmp_path / "long.ssp", edited(long))

    [finding] = fmu_mesh.load(path).check().findings

    assert finding.line == LINE + 80_000


@pytest.mark.parametrize("way", ["CRLF", "UTF-16"])
def test_a_document_type_is_refused_with_its_line(way: str, tmp_path: Path) -> None:
    text = TEXT.replace("?>\n", '?>\n\n<!DOCTYPE x [<!ENTITY a "b">]>\n', 1)
    path = write_package(tmp_path / "bad.ssp", edited(WRITTEN[way](text)))

    with pytest.raises(fmu_mesh.ConfigurationError, match="a document type") as caught:
        fmu_mesh.load(path)

    assert [finding.line for finding in caught.value.findings] == [3]


def test_a_name_with_line_breaks_and_control_signs_stays_in_one_line(tmp_path: Path) -> None:
    text = WRONG.replace('name="gain"', 'name="ga&#10;in\u202e\u009b"').replace('"gain"', '"ga&#10;in\u202e\u009b"')
    path = write_package(tmp_path / "bad.ssp", edited(text))

    findings = fmu_mesh.load(path).check().findings

    assert any(r"'ga\nin\u202e\x9b'" in str(finding) for finding in findings)
    assert all(str(finding).isprintable() for finding in findings)


def cut(path: Path) -> None:
    write_package(path, GOOD)
    path.write_bytes(path.read_bytes()[:-500])


def bomb(path: Path) -> None:
    write_package(path, {**GOOD, "extra/zeros": b"\0" * 2**28})


def backslashes(path: Path) -> None:
    with zipfile.ZipFile(path, "w") as archive:
        for name, content in GOOD.items():
            entry = zipfile.ZipInfo(name)
            entry.filename = name.replace("/", "\\")
            archive.writestr(entry, content)


def nameless(path: Path) -> None:
    write_package(path, {**GOOD, "\x01": ""})
    path.write_bytes(path.read_bytes().replace(b"\x01PK", b"\0PK"))  # a name ends at a zero


def uri_with_backslash(path: Path) -> None:
    write_package(path, edited(TEXT.replace("resources/Gain.fmu", "resources\\Gain.fmu")))


DAMAGED: dict[str, tuple[str, Callable[[Path], object], str]] = {
    "an end that is missing": ("a.ssp", cut, "its end is missing: was it copied completely?"),
    "an empty file": ("a.ssp", lambda path: path.write_bytes(b""), "is no ZIP archive. The file is empty."),
    "a description as an archive": ("a.ssp", lambda path: path.write_text(TEXT), "It is XML: name it .ssd"),
    "an archive as a description": ("a.ssd", lambda path: path.write_bytes(b"PK\x03\x04"), "Name it .ssp."),
    "a bomb": ("a.ssp", bomb, "If you trust it, unpack it, and name the folder instead."),
    "an entry without a name": ("a.ssp", nameless, "is a damaged ZIP archive: it has an entry without a name."),
    "a URI with a backslash": ("a.ssp", uri_with_backslash, "Did you mean 'resources/Gain.fmu'?"),
    "another case": (
        "a.ssp",
        lambda path: write_package(path, edited(TEXT.replace("resources/Gain", "Resources/gain"))),
        "Did you mean 'resources/Gain.fmu'?",
    ),
    "an element of XInclude": (
        "a.ssp",
        lambda path: write_package(
            path,
            edited(TEXT.replace("<ssd:Elements>", '<ssd:Elements><i:include xmlns:i="urn:i" href="/etc/hosts"/>', 1)),
        ),
        "the element include in Elements",
    ),
}


def test_a_package_with_backslashes_of_windows_is_read(tmp_path: Path) -> None:
    backslashes(tmp_path / "a.ssp")

    assert fmu_mesh.load(tmp_path / "a.ssp").check()


def beside(folder: Path, source: str) -> Path:
    """A package in a folder, whose FMU lies outside of it."""
    package = write_package(folder / "good.ssp", edited(TEXT.replace("resources/Gain.fmu", source)))
    with zipfile.ZipFile(package) as archive:
        archive.extractall(folder / "systems" / "own")
    (folder / "fmus").mkdir()
    (folder / "systems/own/resources/Gain.fmu").rename(folder / "fmus/Gain.fmu")
    return folder / "systems" / "own" / SSD


def test_a_description_in_a_folder_may_name_an_fmu_beside_it(tmp_path: Path) -> None:
    ssd = beside(tmp_path, "../../fmus/Gain.fmu")

    assert fmu_mesh.load(ssd).check()
    assert fmu_mesh.load(ssd.parent).check()


def test_a_missing_file_beside_a_folder_is_told(tmp_path: Path) -> None:
    ssd = beside(tmp_path, "../../fmus/Gian.fmu")

    [finding] = fmu_mesh.load(ssd).check().findings

    assert "no such file '../../fmus/Gian.fmu'" in finding.found


def test_an_archive_in_a_folder_names_nothing_outside_of_itself(tmp_path: Path) -> None:
    beside(tmp_path, "../../fmus/Gain.fmu")
    inner = tmp_path / "systems" / "own" / "inner.ssp"
    (tmp_path / "good.ssp").rename(inner)

    [finding] = fmu_mesh.load(inner).check().findings

    assert "leads out of the package" in finding.found


@pytest.mark.parametrize("fault", DAMAGED)
def test_a_damaged_package_is_refused_with_the_way_out(fault: str, tmp_path: Path) -> None:
    name, write, words = DAMAGED[fault]
    write(tmp_path / name)

    with pytest.raises(fmu_mesh.ConfigurationError) as caught:
        fmu_mesh.load(tmp_path / name).check().require()

    assert words in "\n".join(map(str, [caught.value, *caught.value.findings]))


def test_file_of_package_that_cannot_be_unpacked_keeps_it_from_being_exported(tmp_path: Path) -> None:
    path = write_package(tmp_path / "odd.ssp", {**GOOD, "extra.bin": "?"})
    data = bytearray(path.read_bytes())
    data[data.rindex(b"extra.bin") - 46 + 10] = 99  # its compression, in the list of files
    path.write_bytes(data)
    mesh = fmu_mesh.load(path)

    with pytest.raises(fmu_mesh.ConfigurationError, match="compression method is not supported"):
        mesh.to_ssp(tmp_path / "made.ssp")

    assert mesh.check()
    assert [file.name for file in tmp_path.iterdir()] == ["odd.ssp"]


@pytest.mark.parametrize(
    "uri", ["resources/My%20G%C3%A4in.fmu", "resources/My Gäin.fmu", "./resources/x/../My%20Gäin.fmu"]
)
def test_a_uri_may_be_percent_encoded(uri: str, tmp_path: Path) -> None:
    files = edited(TEXT.replace("resources/Gain.fmu", uri), **{"resources/My Gäin.fmu": GOOD["resources/Gain.fmu"]})

    assert fmu_mesh.load(write_package(tmp_path / "good.ssp", files)).check()
