"""The project's files agree with one another: versions, packages, commands and checks."""

import importlib
import importlib.metadata
import pkgutil
import re
import shlex
import subprocess
import sys
import tarfile
import zipfile
from collections.abc import Callable
from pathlib import Path

import pytest
import yaml
from hatchling.builders.sdist import SdistBuilder
from hatchling.builders.wheel import WheelBuilder

import fmu_mesh
from fmu_mesh.cli.main import command_parser
from fmu_mesh.errors import ConfigurationError
from tests import house
from tests.commit_subject import problems_of

ROOT = Path(__file__).parents[2]
MODULES = sorted(
    module.name
    for module in pkgutil.walk_packages(fmu_mesh.__path__, "fmu_mesh.")
    if not module.name.endswith("__main__") and "-" not in module.name  # a library of C is no module
)


def text(path: str) -> str:
    return (ROOT / path).read_text(encoding="utf-8")


def test_installed_version_is_that_of_package_and_has_its_entry_in_changelog() -> None:
    assert importlib.metadata.version("fmu-mesh") == fmu_mesh.__version__
    assert re.search(rf"^## \[{re.escape(fmu_mesh.__version__)}\]", text("CHANGELOG.md"), re.MULTILINE)


@pytest.mark.parametrize("name", MODULES)
def test_a_module_has_what_it_says_it_exports(name: str) -> None:
    module = importlib.import_module(name)

    assert [export for export in getattr(module, "__all__", []) if not hasattr(module, export)] == []


def test_importing_the_whole_package_prints_nothing() -> None:
    program = "import importlib, sys\nfor name in sys.argv[1:]: importlib.import_module(name)"

    done = subprocess.run([sys.executable, "-W", "error", "-c", program, *MODULES], capture_output=True, check=True)

    assert (done.stdout, done.stderr) == (b"", b"")


def test_the_wheel_holds_the_typed_package_and_nothing_else(tmp_path: Path) -> None:
    wheel = next(WheelBuilder(str(ROOT)).build(directory=str(tmp_path), versions=["standard"]))
    with zipfile.ZipFile(wheel) as archive:
        names = archive.namelist()

    assert {name.split("/")[0] for name in names} == {
        "fmu_mesh",
        f"fmu_mesh-{fmu_mesh.__version__}.dist-info",
    }
    assert "fmu_mesh/py.typed" in names
    assert [name for name in names if name.endswith(".pyc")] == []


def test_the_source_distribution_has_the_tests_and_what_they_need(tmp_path: Path) -> None:
    sdist = next(SdistBuilder(str(ROOT)).build(directory=str(tmp_path), versions=["standard"]))
    with tarfile.open(sdist) as archive:
        tops = {Path(name).parts[1] for name in archive.getnames()}

    assert {"LICENSE", "Makefile", "configs", "docker", "fmu_mesh", "fmus", "pyproject.toml", "tests"} <= tops
    assert {".venv", "results", "dist"} & tops == set()


def test_every_rule_that_is_switched_off_says_why() -> None:
    lists = re.findall(r'^(?:ignore|"[\w*/]+") = \[\n(.*?)^\]', text("pyproject.toml"), re.MULTILINE | re.DOTALL)
    rules = [line for entries in lists for line in entries.splitlines()]

    assert rules
    assert [line for line in rules if not re.search(r'^  "\w+", +# \S', line)] == []


def test_every_check_that_a_line_switches_off_says_why() -> None:
    switch = re.compile(r"#\s*(noqa|type: ignore|pragma: no)\b")
    with_reason = re.compile(r"#\s*(noqa: [A-Z0-9, ]+|type: ignore\[[\w, -]+\]|pragma: no (cover|branch))\W+\w")
    silent = [
        f"{path.relative_to(ROOT)}:{number}: {line.strip()}"
        for folder in ("fmu_mesh", "tests")
        for path in sorted((ROOT / folder).rglob("*.py"))
        if path != Path(__file__)
        for number, line in enumerate(path.read_text(encoding="utf-8").splitlines(), start=1)
        if switch.search(line) and not with_reason.search(line)
    ]

    assert silent == []


def test_a_commit_is_checked_by_the_tools_of_make_check() -> None:
    checks = set(re.findall(r"^\trun ([\w-]+)", text("Makefile"), re.MULTILINE))
    hooks = yaml.safe_load(text(".pre-commit-config.yaml"))["repos"][0]["hooks"]

    assert checks
    assert {Path(hook["entry"].split()[0]).name for hook in hooks if "stages" not in hook} == checks


@pytest.mark.parametrize(
    "subject", ["Read CSV in blocks", "Bring back the grant", "Press on", "Merge branch 'a'", "A" * 72]
)
def test_a_subject_that_is_a_command_is_taken(subject: str) -> None:
    assert problems_of(subject) == []


@pytest.mark.parametrize(
    ("subject", "problem"),
    [
        ("Read CSV in blocks, WIP", "instead of 'wip'"),
        ("Added a reader", "not with 'Added'"),
        ("Reading CSV in blocks", "not with 'Reading'"),
        ("Fixes a hang", "not with 'Fixes'"),
        ("The reader takes blocks", "not with 'The'"),
        ("fix: a hang", "without a prefix"),
        ("", "begin with a verb"),
        ("Read CSV in blocks.", "full stop"),
        ("Read " + "long " * 14, "it has 75 characters; at most 72"),
    ],
)
def test_a_subject_that_is_no_command_is_refused(subject: str, problem: str) -> None:
    assert [found for found in problems_of(subject) if problem in found]


def test_the_hook_reads_the_first_line_of_a_message(tmp_path: Path) -> None:
    message = tmp_path / "COMMIT_EDITMSG"
    message.write_text("# of git\nAdded a reader\n\nRead CSV in blocks.\n", encoding="utf-8")
    hook = next(
        hook for hook in yaml.safe_load(text(".pre-commit-config.yaml"))["repos"][0]["hooks"] if "stages" in hook
    )

    done = subprocess.run([*hook["entry"].split(), message], cwd=ROOT, capture_output=True, text=True, check=False)

    assert done.returncode == 1
    assert "'Added a reader'" in done.stderr


def test_the_list_of_decisions_has_all_with_their_status() -> None:
    rows = []
    for path in sorted((ROOT / "docs/adr").glob("[0-9]*.md")):
        decision = path.read_text(encoding="utf-8")
        title = re.match(r"# \d+\. (.*)", decision)
        status = re.search(r"^Status: (replaced by \[ADR \d+\]\([\w.-]+\))", decision, re.MULTILINE)
        assert title, path
        number = path.name[:4]
        rows.append(f"| [{number}]({path.name}) | {title.group(1)} | {status.group(1) if status else 'accepted'} |")

    assert re.findall(r"^\| \[.*", text("docs/adr/README.md"), re.MULTILINE) == rows


PAGES = [*sorted(ROOT.glob("*.md")), *sorted(ROOT.glob("docs/**/*.md")), *sorted(ROOT.glob("examples/**/*.md"))]


@pytest.mark.parametrize("page", PAGES, ids=lambda page: str(page.relative_to(ROOT)))
def test_every_link_of_a_page_leads_somewhere(page: Path) -> None:
    links = [link for link in re.findall(r"\]\(([^)\s]+)\)", prose(page)) if not re.match(r"[a-z]+:", link)]
    dead = []
    for link in links:
        name, _, heading = link.partition("#")
        target = (page.parent / name).resolve() if name else page
        if not target.exists() or (heading and heading not in headings(target)):
            dead.append(link)

    assert dead == []


def prose(page: Path) -> str:
    """A page without its listings."""
    return re.sub(r"^```.*?^```", "", page.read_text(encoding="utf-8"), flags=re.MULTILINE | re.DOTALL)


def headings(page: Path) -> set[str]:
    """The names under which the headings of a page can be linked to."""
    found = re.findall(r"^#+ (.*)$", prose(page), re.MULTILINE)
    words = [re.sub(r"\[([^\]]*)\]\([^)]*\)", r"\1", heading).strip().lower() for heading in found]
    return {re.sub(r"[^\w\- ]", "", heading).replace(" ", "-") for heading in words}


@pytest.mark.parametrize("page", PAGES, ids=lambda page: str(page.relative_to(ROOT)))
def test_every_module_that_a_page_names_exists(page: Path) -> None:
    named = sorted(set(re.findall(r"`(\w+/[\w/]+\.py)`", page.read_text(encoding="utf-8"))))

    folders = (ROOT, ROOT / "fmu_mesh", ROOT / "tests", page.parent)
    assert [name for name in named if not any((folder / name).exists() for folder in folders)] == []


@pytest.mark.parametrize("page", PAGES, ids=lambda page: str(page.relative_to(ROOT)))
def test_every_command_of_a_page_is_one_that_there_is(page: Path) -> None:
    lines = re.findall(r"^(?:    \$ |\.venv/bin/)?(fmu-mesh [ -~]*)$", page.read_text(encoding="utf-8"), re.MULTILINE)
    wrong = []
    for line in lines:
        arguments = [word for word in shlex.split(line, comments=True)[1:] if word != "&"]
        try:
            command_parser()[0].parse_args(arguments)
        except ConfigurationError as error:
            wrong.append((line, str(error)))

    assert wrong == []


@pytest.mark.parametrize("name", command_parser()[1])
def test_help_of_command_fits_80_columns_and_begins_with_what_it_does(
    name: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setenv("COLUMNS", "80")

    with pytest.raises(SystemExit, match="0"):
        command_parser()[0].parse_args([name, "--help"])

    lines = capsys.readouterr().out.splitlines()
    assert max(map(len, lines)) <= 80
    described = lines[lines.index("") + 1]
    assert described[0].isupper()


@pytest.mark.parametrize("page", sorted(path.name for path in ROOT.glob("*.md")))
def test_every_make_command_that_a_page_names_exists(page: str) -> None:
    targets = set(re.findall(r"^([a-z]+):", text("Makefile"), re.MULTILINE))
    named = set(re.findall(r"^(?:    )?make ([a-z]+)$|`make ([a-z]+)`", text(page), re.MULTILINE))

    assert {fenced or quoted for fenced, quoted in named} <= targets


@pytest.fixture(scope="module")
def package() -> house.Package:
    return house.Package(house.PACKAGE)


@pytest.mark.parametrize("rule", house.RULES, ids=lambda rule: rule.__name__)
def test_the_package_keeps_a_rule_of_the_house(
    rule: Callable[[house.Package], set[str]], package: house.Package
) -> None:
    # Equal, not within: what has been mended leaves the list, so that it cannot come back unseen.
    assert rule(package) == house.ALLOWED.get(rule.__name__, {}).keys()


def test_every_list_belongs_to_a_rule() -> None:
    assert house.ALLOWED.keys() <= {rule.__name__ for rule in house.RULES}


def test_few_helpers_are_used_once(package: house.Package) -> None:
    found = house.one_use_helpers(package)

    # A number and no list: a name that says more than its lines may stay, and another one goes.
    assert len(found) <= house.MOST_ONE_USE_HELPERS, sorted(found)


def test_the_name_of_a_test_is_a_short_sentence() -> None:
    assert house.long_names_of_tests(house.TESTS) == set()


def test_each_rule_of_the_house_finds_what_breaks_it(tmp_path: Path) -> None:
    for path, code in BROKEN.items():
        (tmp_path / "p" / path).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / "p" / path).write_text(code, encoding="utf-8")
    package = house.Package(tmp_path / "p")

    assert {rule.__name__: rule(package) for rule in house.RULES} == {
        "file_names_used_twice": {"user"},
        "class_names_used_twice": {"Thing"},
        "small_modules_with_one_importer": {"things.py"},
        "large_modules": {"long.py"},
        "attributes_assigned_from_outside": {
            "long.py: self._thing.size",
            "long.py: thing.size",
            "long.py: setattr(thing)",
        },
        "private_names_of_others": {"long.py: _hidden", "long.py: _size", "long.py: thing._size", "long.py: f_locals"},
        "rebound_calls": {"long.py: Owner.call", "long.py: Owner.inherited", "long.py: Owner._read"},
        "importers_of_kinds": {"p.long: p.instances.clay"},
        "names_of_sections": {"long.py: ClaySection"},
        "threads_without_a_reason": {"things.py", "instances/clay/section.py"},
    }
    assert house.one_use_helpers(package) == {"locked.py: _once"}


def test_the_rule_for_names_of_tests_counts_words(tmp_path: Path) -> None:
    twelve = "_".join(["word"] * 12)
    (tmp_path / "test_words.py").write_text(
        f"def test_{twelve}(): ...\ndef test_{twelve}_more(): ...\n", encoding="utf-8"
    )

    assert house.long_names_of_tests(tmp_path) == {f"test_words.py: {twelve}_more"}


BROKEN = {
    "things.py": "class Thing:\n    lock = threading.Lock()\n    def inherited(self): ...\n_hidden = 1\n",
    "locked.py": """'''A user of threads.'''
# Which threads meet here (ADR 0067).
import threading
LOCK = threading.Lock()
def _once(): ...
def _twice(): ...
_once(), _twice(), _twice()
""",
    "one_class.py": "class Long: ...\ndef _helper(): ...\n_helper(), _helper()\n" + "\n" * (house.LARGE + 1),
    "cli/user.py": "from ..instances.registry import kinds\n",
    "run/user.py": "from ..instances import registry\n",
    "instances/registry.py": "",
    "instances/clay/__init__.py": "from .section import ClaySection\n",
    "instances/clay/section.py": "import signal\nclass ClaySection(Struct, tag='clay'): ...\nsignal.signal(2, None)"
    + "  # in the main thread, ADR 0067\n" * house.SMALL,
    "long.py": """
from .instances.clay import ClaySection
from .things import _hidden
class Thing:
    def inherited(self): ...
class Owner(Thing):
    kept: Callable[[], None]
    def __init__(self, thing):
        self._thing = thing
        self._read = thing.read
        self.kept: Callable[[], None]
        self.kept = thing.keep
    def call(self):
        self._thing.size = 1
        read = self._read
        read()
    def bind(self, thing, section: ClaySection):
        self.call = self.inherited = thing.call
        self._read = thing.read_faster
        thing.size += 1
        setattr(thing, "size", 2)
        getattr(thing, "_size")
        thing._size  # noqa: SLF001 it is there
        frame.f_locals
"""
    + "\n" * house.LARGE,
}
"""A package that breaks each rule."""
