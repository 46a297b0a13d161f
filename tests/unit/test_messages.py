"""Messages of FMUs: which instance they are told of, whatever name and address the FMU gives its logger."""

from __future__ import annotations

import re
from collections.abc import Iterator
from contextlib import ExitStack
from pathlib import Path
from typing import Literal

import psutil
import pytest
import yaml

from fmu_mesh.cli.main import main
from fmu_mesh.errors import StepFailed
from fmu_mesh.instances.contract import LogMessage
from fmu_mesh.instances.fmi.archive.reading import read_description
from fmu_mesh.instances.fmi.archive.sources import extract
from fmu_mesh.instances.fmi.fmu_instance import FmuInstance
from fmu_mesh.instances.fmi.opening import open_instance
from fmu_mesh.rings.library import load_library
from tests.fmus.chatty_fmus import chatty_fmu
from tests.fmus.event_fmus import SOURCES, event_source_fmu
from tests.fmus.helpers import NO_COMPILER, find_fmu
from tests.fmus.packing import repacked, without_binaries

pytestmark = pytest.mark.skipif(NO_COMPILER is not None, reason=str(NO_COMPILER))

LIMITED = pytest.mark.skipif(load_library() is None, reason="without the library of C, all messages are passed on")
SAYS = "the step is too long"
OWN_2, OWN_1 = "instance->environment, instance->name,", "m->logger(NULL, m->name, Discard"

Version = Literal[1, 2]


@pytest.fixture(autouse=True)
def cache(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A cache of the test's own."""
    monkeypatch.setenv("FMU_MESH_CACHE_DIR", str(tmp_path / "cache"))


def logging_fmu(version: Version, address: str, name: str, folder: Path) -> Path:
    """An FMU that discards steps longer than `longest_step`, and calls its logger with this address and name (in C)."""
    target = folder / "logging.fmu"
    if version == 2:
        code = (SOURCES / "fmi2.c").read_text()
        assert OWN_2 in code
        return event_source_fmu("Stairs", 2, target, add={"sources/fmi2.c": code.replace(OWN_2, f"{address}, {name},")})
    sources = without_binaries(folder / "sources.fmu", source=find_fmu("Steps1", folder))
    folder_of_sources = extract(sources, folder / "sources") / "sources"
    code = (folder_of_sources / "steps.h").read_text()
    assert OWN_1 in code
    changed = code.replace(OWN_1, f"m->logger({address}, {name}, Discard").encode()
    return repacked(
        target,
        source=sources,
        description=lambda text: text.replace('canRejectSteps="true"', 'canRejectSteps="false"'),
        keep=lambda one: one != "sources/steps.h",
        add={"sources/steps.h": changed},
    )


class Pair:
    """Two instances of one FMU in one process, with what is told of each."""

    def __init__(self, fmu: Path, folder: Path, stack: ExitStack) -> None:
        self.told: dict[str, list[LogMessage]] = {"first": [], "second": []}
        description = read_description(fmu)
        self.instances: dict[str, FmuInstance] = {}
        for name, told in self.told.items():
            instance = open_instance(fmu, name, description, folder, told.append)
            stack.callback(instance.close)
            instance.enter_initialization(0.0, 1.0, {"longest_step": 0.2})
            instance.exit_initialization()
            self.instances[name] = instance


@pytest.fixture
def stack() -> Iterator[ExitStack]:
    with ExitStack() as stack:
        yield stack


@pytest.mark.parametrize(
    ("version", "address", "name"),
    [
        pytest.param(2, "instance->environment", '"20-sim"', id="FMI 2, the environment and another name"),
        pytest.param(2, "instance->environment", '"first"', id="FMI 2, the environment and the name of the other"),
        pytest.param(2, "instance", '"20-sim"', id="FMI 2, the component and another name"),
        pytest.param(2, "NULL", "instance->name", id="FMI 2, the name only"),
        pytest.param(2, "(void *)4711", "instance->name", id="FMI 2, nobody's address and the name"),
        pytest.param(1, "m", '"20-sim"', id="FMI 1, the component and another name"),
        pytest.param(1, "m", "NULL", id="FMI 1, the component only"),
        pytest.param(1, "NULL", "m->name", id="FMI 1, the name only"),
    ],
)
def test_a_message_is_told_of_the_instance_that_it_comes_from(
    version: Version, address: str, name: str, tmp_path: Path, stack: ExitStack
) -> None:
    pair = Pair(logging_fmu(version, address, name, tmp_path), tmp_path, stack)

    with pytest.raises(StepFailed, match=f"DoStep returned discard; .*the FMU says: {SAYS}"):
        pair.instances["second"].advance(0.0, 0.25)

    assert [(one.instance, one.message) for one in pair.told["second"]] == [("second", SAYS)]
    assert pair.told["first"] == []


def test_a_message_of_fmi_3_is_told_of_its_instance_only(tmp_path: Path, stack: ExitStack) -> None:
    pair = Pair(chatty_fmu(3, tmp_path, "co_simulation"), tmp_path, stack)

    pair.instances["second"].advance(0.0, 0.1)
    for instance in pair.instances.values():
        instance.close()

    first, second = (sum(shown_and_counted(pair.told[name], "iteration")) for name in pair.told)
    assert second == first + 20


@pytest.mark.parametrize("version", [1, 2])
@pytest.mark.parametrize("name", ['"20-sim"', "NULL"])
def test_a_message_of_nobody_is_told_of_every_instance(
    name: str, version: Version, tmp_path: Path, stack: ExitStack
) -> None:
    pair = Pair(logging_fmu(version, "NULL", name, tmp_path), tmp_path, stack)

    with pytest.raises(StepFailed, match=f"the FMU says: {SAYS}"):
        pair.instances["second"].advance(0.0, 0.25)

    for own, told in pair.told.items():
        assert [(one.instance, one.message) for one in told] == [(own, SAYS)]


def test_a_closed_instance_gets_no_messages_any_more(tmp_path: Path, stack: ExitStack) -> None:
    pair = Pair(logging_fmu(2, "NULL", '"20-sim"', tmp_path), tmp_path, stack)
    pair.instances["first"].close()

    with pytest.raises(StepFailed, match=f"the FMU says: {SAYS}"):
        pair.instances["second"].advance(0.0, 0.25)

    assert pair.told["first"] == []


def test_a_run_says_what_an_fmu_says_under_another_name(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    fmu = logging_fmu(2, "NULL", '"20-sim"', tmp_path)
    content = {
        "mesh": "one",
        "simulation": {"stop_time": 1, "step_size": 0.25},
        "instances": {"stairs": {"fmu": fmu.name, "start_values": {"longest_step": 0.2}}},
        "record": {"file": None},
    }
    config = tmp_path / "one.yaml"
    config.write_text(yaml.safe_dump(content), encoding="utf-8")

    assert main(["launch", "--local", str(config)]) == 3

    said = capsys.readouterr().err
    assert f"the FMU says: {SAYS}" in said
    assert said.count(SAYS) == 1


def opened(fmu: Path, folder: Path, told: list[LogMessage]) -> FmuInstance:
    instance = open_instance(fmu, "it", read_description(fmu), folder, told.append)
    instance.enter_initialization(0.0, 100.0, {"longest_step": 0.2})
    instance.exit_initialization()
    return instance


def shown_and_counted(told: list[LogMessage], text: str) -> tuple[int, int]:
    """How many messages with ``text`` were passed on, and how many were only counted."""
    counts = [
        re.fullmatch(r"([\d,]+) more messages? like '(.*)' \(a\) (was|were) not shown", one.message) for one in told
    ]
    counted = sum(int(one[1].replace(",", "")) for one in counts if one is not None and text in one[2])
    return sum(one.message.startswith(text) for one in told), counted


@LIMITED
@pytest.mark.parametrize("version", [2, 3])
@pytest.mark.parametrize("kind", ["co_simulation", "model_exchange"])
def test_every_message_of_a_chatty_fmu_is_shown_or_counted(version: Literal[2, 3], kind: str, tmp_path: Path) -> None:
    told: list[LogMessage] = []
    instance = opened(chatty_fmu(version, tmp_path, kind), tmp_path, told)
    for step in range(30):
        instance.advance(step * 0.1, 0.1)

    instance.close()

    shown, counted = shown_and_counted(told, "iteration")
    total = next(one.message for one in told if one.message.endswith("in all"))
    assert f"{shown + counted} in all" == total
    assert shown >= 100
    assert counted > shown
    assert {one.status for one in told} == {"warning"}


@LIMITED
def test_a_chatty_fmu_takes_no_more_memory_with_time(tmp_path: Path) -> None:
    told: list[LogMessage] = []
    instance = opened(chatty_fmu(2, tmp_path, "co_simulation"), tmp_path, told)
    process = psutil.Process()
    instance.advance(0.0, 0.001)
    before = process.memory_info().rss

    for step in range(1, 20_000):
        instance.advance(step * 0.001, 0.001)

    assert process.memory_info().rss - before < 20 << 20  # 400,000 messages would be 100 MB
    assert len(told) < 500
    instance.close()


@LIMITED
def test_what_was_only_counted_still_says_why_a_step_fails(tmp_path: Path) -> None:
    told: list[LogMessage] = []
    instance = opened(chatty_fmu(2, tmp_path, "co_simulation"), tmp_path, told)
    for step in range(30):
        instance.advance(step * 0.1, 0.1)

    with pytest.raises(StepFailed, match=r"the FMU says: iteration \d+ \| iteration \d+ \| iteration \d+") as caught:
        instance.advance(3.0, 0.25)

    last = max(int(number) for number in re.findall(r"iteration (\d+)", str(caught.value)))
    assert shown_and_counted(told, "iteration") == (100, last + 1 - 100)
    instance.close()


_THREAD = """
        static long others;
        pthread_t thread;
        if (strcmp(function, "fmi2DoStep") == 0) {
            void *run(void *c)
            {
                Instance *own = c;
                for (int n = 0; n < 5000; n++)
                    own->logger(own->environment, own->name, fmi2Warning, "a", "thread %ld", others++);
                return NULL;
            }
            pthread_create(&thread, NULL, run, instance);
            for (int n = 0; n < 5000; n++)
                instance->logger(instance->environment, instance->name, fmi2Warning, "a", "main %d", n);
            pthread_join(thread, NULL);
        }
"""


@LIMITED
def test_messages_of_two_threads_of_an_fmu_are_all_counted(tmp_path: Path) -> None:
    told: list[LogMessage] = []
    instance = opened(chatty_fmu(2, tmp_path, "co_simulation", _THREAD), tmp_path, told)

    instance.advance(0.0, 0.1)
    instance.close()

    assert sum(shown_and_counted(told, "thread")) == 5000
    assert sum(shown_and_counted(told, "main")) == 5000


@LIMITED
def test_an_fmu_with_a_new_kind_of_message_each_time_is_limited(tmp_path: Path) -> None:
    once = """
        static int number;
        char letters[5] = "";
        for (int n = 0; n < 1000; n++, number++) {
            for (int digit = 0; digit < 4; digit++) letters[digit] = (char)('a' + (number >> 4 * digit) % 16);
            instance->logger(instance->environment, instance->name, fmi2Warning, "b", letters);
        }
    """
    told: list[LogMessage] = []
    instance = opened(chatty_fmu(2, tmp_path, "co_simulation", once), tmp_path, told)
    for step in range(10):
        instance.advance(step * 0.1, 0.1)

    instance.close()

    assert len([one for one in told if one.category == "b"]) < 1000
