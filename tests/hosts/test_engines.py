"""What `render` writes for engines: read as the engine reads it, and run as plain processes without the engine."""

from __future__ import annotations

import os
import re
import shlex
import shutil
import signal
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import kubernetes_validate
import psutil
import pytest
import yaml
from hypothesis import given
from hypothesis import strategies as st

from fmu_mesh.cli.main import main
from fmu_mesh.hosts.processes import names_for
from fmu_mesh.run import preparing
from fmu_mesh.wire.security.authority import Authority
from tests.helpers import DEADLINE_S, FAILING, Place, free_port, row_count, wait_until, write_config

SRUN = """\
#!/bin/sh
for file; do :; done
while read -r _ command; do eval "$command" & done <"$file"
wait
"""
"""Stands for srun on one host: it starts each task of the file of `--multi-prog`."""


@pytest.fixture
def place() -> Iterator[Place]:
    with Place() as own:
        programs = own.folder / "programs"
        programs.mkdir()
        (programs / "srun").write_text(SRUN, encoding="utf-8")
        (programs / "srun").chmod(0o755)
        own.environment |= {"PATH": f"{programs}:{os.environ['PATH']}"}
        yield own


def rendered(capsys: pytest.CaptureFixture[str], engine: str, *words: str | Path) -> str:
    """What `render` prints."""
    assert main(["render", engine, *map(str, words)]) == 0, capsys.readouterr().err
    return capsys.readouterr().out


def main_job(folder: Path, **process: str) -> Path:
    """The pair, with its models beside it, as in the volume of a cluster."""
    (folder / "models").mkdir()
    instances: dict[str, dict[str, Any]] = {
        "pendulum": {"fmu": "models/DampedPendulum.fmu", "process": process},
        "delay": {"fmu": "models/TransportDelay.fmu", "start_values": {"d": 0.1}},
    }
    for name in ("DampedPendulum", "TransportDelay"):
        (folder / "models" / f"{name}.fmu").write_bytes((Path(__file__).parents[2] / f"fmus/{name}.fmu").read_bytes())
    return write_config(folder, instances=instances, record={"file": "results/pair.csv"})


def refused(capsys: pytest.CaptureFixture[str], *words: str | Path) -> str:
    """The error of a command that is wrong."""
    assert main([*map(str, words)]) == 2
    return capsys.readouterr().err.splitlines()[-1].removeprefix("fmu-mesh: ")


def command_of(process: psutil.Process) -> list[str]:
    """Its words; none if it has ended meanwhile."""
    try:
        return process.cmdline()
    except psutil.NoSuchProcess:
        return []


def settings_of(script: str) -> list[list[str]]:
    """The options of `sbatch` in a script, for each component of the job."""
    components: list[list[str]] = [[]]
    for setting in re.findall(r"^#SBATCH (.*)$", script, re.MULTILINE):
        if setting == "hetjob":
            components.append([])
        else:
            components[-1].append(setting)
    return components


def test_a_batch_script_does_the_job_of_launch(place: Place) -> None:
    config = write_config(place.folder)
    script = place.folder / "a job.sbatch"
    local = place.run("launch", config, "--local", "--output", "local.csv", "--set", "pendulum.l=2.5")
    render = place.run("render", "slurm", config, "--insecure", "--set", "pendulum.l=2.5", "-o", script)

    job = place.start_command(["sh", str(script)])

    assert (local.wait(), render.wait(), job.wait()) == (0, 0, 0), place.story()
    assert config.with_suffix(".csv").read_bytes() == (place.folder / "local.csv").read_bytes()
    place.assert_nothing_left(DEADLINE_S)


def test_paths_that_a_shell_could_misread_reach_nodes(place: Place) -> None:
    folder = place.folder / "a $HOME, `5%t` \\ mesh"
    folder.mkdir()
    config = write_config(folder)
    place.run("render", "slurm", config, "--insecure", "-o", "job")

    job = place.start_command(["sh", "job"])

    assert job.wait() == 0, place.story()
    assert row_count(config.with_suffix(".csv")) == 1001


def test_a_batch_script_ends_with_the_code_of_the_master(place: Place) -> None:
    (place.folder / "failing.py").write_text(FAILING, encoding="utf-8")
    config = write_config(place.folder, instances={"tank": {"python": "failing.py:Failing"}}, connections=())
    place.run("render", "slurm", config, "--insecure", "-o", "job")

    job = place.start_command(["sh", "job"])

    assert job.wait() == 3, place.story()
    assert "the tank is empty" in job.errors


def test_a_killed_task_ends_the_job_with_code_four(place: Place) -> None:
    config = write_config(place.folder, stop_time=1e4, simulation={"real_time_factor": 1.0})
    place.run("render", "slurm", config, "--insecure", "-o", "job")
    job = place.start_command(["sh", "job"])
    wait_until(lambda: row_count(config.with_suffix(".csv")) > 0, "rows")

    [node] = [one for one in place.processes() if {"node", "delay"} <= {*command_of(one)}]
    node.kill()

    assert job.wait() == 4, place.story()
    assert "instance delay" in job.errors
    place.assert_nothing_left(DEADLINE_S)


def test_a_terminated_script_ends_its_master_in_order(place: Place) -> None:
    config = write_config(place.folder, stop_time=1e4, simulation={"real_time_factor": 1.0})
    place.run("render", "slurm", config, "--insecure", "-o", "job")
    job = place.start_command(["sh", "job"])
    wait_until(lambda: row_count(config.with_suffix(".csv")) > 0, "rows")

    job.signal(signal.SIGTERM)

    assert job.wait() == 130, place.story()
    place.assert_nothing_left(DEADLINE_S)


def test_hosts_and_memory_become_components_of_a_job(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    instances: dict[str, dict[str, Any]] = {
        "first": {"fmu": "Gain", "host": "big", "process": {"memory": "1 GiB"}},
        "second": {"fmu": "Gain", "host": "big", "process": {"memory": "2 GiB"}},
        "third": {"fmu": "Gain", "process": {"memory": "100 MiB"}},
        "fourth": {"fmu": "Gain"},
    }
    config = write_config(tmp_path, instances=instances, connections=(), deploy={"hosts": {"big": {}}})

    script = rendered(capsys, "slurm", config, "--insecure", "--slurm-option=--partition=long")

    assert settings_of(script) == [
        ["--job-name=pair", "--no-requeue", "--ntasks=3", "--cpus-per-task=1", "--partition=long"],
        ["--ntasks=2", "--cpus-per-task=1", "--nodes=1", "--mem-per-cpu=2304M", "--partition=long"],
    ]
    assert re.findall(r"^\d (?:\S+ ){4}\S+ (\w+)", script, re.MULTILINE) == ["third", "fourth", "first", "second"]
    assert re.findall(r"^srun (--het-group=\d --ntasks=\d)", script, re.MULTILINE) == [
        "--het-group=0 --ntasks=2",
        "--het-group=1 --ntasks=2",
    ]
    subprocess.run(["sh", "-n"], input=script, text=True, check=True, timeout=DEADLINE_S)


def kept(folder: Path, **sections: Any) -> Path:  # noqa: ANN401  they are sections
    """The pair, slow enough to be ended, with what it needs to go on."""
    pace = {"real_time_factor": 0.4}
    return write_config(folder, simulation=pace, recovery={"directory": "kept"}, **sections)


def test_a_script_that_is_run_again_resumes_its_run(place: Place) -> None:
    config, run = kept(place.folder), place.folder / "kept" / "run"
    local = place.run("launch", config, "--local", "--set-config", "recovery.directory=null", "--output", "local.csv")
    render = place.run("render", "slurm", config, "--set-config", "simulation.window=64", "-o", "job")
    job = place.start_command(["sh", "job"])
    wait_until(lambda: row_count(config.with_suffix(".csv")) > 0, "rows")
    job.signal(signal.SIGTERM)
    interrupted, was_kept = job.wait(), run.exists()

    place.environment |= {"SLURM_RESTART_COUNT": "1"}
    again = place.start_command(["sh", "job"])

    assert (local.wait(), render.wait(), interrupted, was_kept, again.wait()) == (0, 0, 130, True, 0), place.story()
    assert "the run is resumed, and goes on from point" in again.errors
    assert config.with_suffix(".csv").read_bytes() == (place.folder / "local.csv").read_bytes()
    place.assert_nothing_left(DEADLINE_S)


def test_a_script_that_had_not_begun_begins_its_run(place: Place) -> None:
    config = kept(place.folder)
    place.run("render", "slurm", config, "-o", "job")
    place.environment |= {"SLURM_RESTART_COUNT": "1"}

    job = place.start_command(["sh", "job"])

    assert job.wait() == 0, place.story()
    assert row_count(config.with_suffix(".csv")) == 1001


def test_a_job_that_can_be_resumed_is_one_task(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    config = kept(tmp_path, process={"memory": "1 GiB"})

    script, resumed = rendered(capsys, "slurm", config), rendered(capsys, "slurm", config, "--resume")

    own = ["--requeue", "--open-mode=append", "--ntasks=1", "--cpus-per-task=3", "--mem-per-cpu=1280M"]
    assert settings_of(script) == [["--job-name=pair", *own]]
    assert (re.findall("^resume=.*$", script, re.MULTILINE), re.findall("^resume=.*$", resumed, re.MULTILINE)) == (
        ["resume="],
        ["resume=--resume"],
    )


def test_what_no_engine_can_resume_is_refused(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    host = {"deploy": {"hosts": {"big": {}}}, "connections": ()}
    config = kept(tmp_path, instances={"gain": {"fmu": "Gain", "host": "big"}}, **host)
    text = "`recovery.directory` of mesh 'pair' has no effect where an engine starts its processes."

    for engine in ("slurm", "compose", "kubernetes"):
        assert refused(capsys, "render", engine, config, "--insecure").startswith(text)
    none = "recovery.directory=null"
    assert refused(capsys, "render", "slurm", config, "--insecure", "--set-config", none, "--resume").startswith(
        "the job of mesh 'pair' cannot be resumed: it keeps nothing."
    )
    assert refused(capsys, "render", "compose", config, "--resume") == "`render compose` takes no --resume"


def test_nobody_is_let_in_who_was_not_asked_for(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    config = write_config(tmp_path)

    for command in (("render", "slurm"), ("render", "compose"), ("render", "kubernetes"), ("submit", "slurm")):
        text = refused(capsys, *command, config)
        assert text.startswith("the processes of mesh 'pair' meet at a network, and nobody has said who may reach it.")
        assert "`--security`" in text
        assert "`--insecure`" in text
    assert [path.name for path in tmp_path.iterdir()] == ["pair.yaml"]


@pytest.mark.parametrize(
    ("sections", "found"),
    [
        ({"zenoh": {"mode": "client", "connect": ["tcp/127.0.0.1:7447"]}}, "has `zenoh.mode: client`"),
        ({"process": {"sandbox": "bubblewrap"}}, "`sandbox` of node 'pendulum', node 'delay' has no effect"),
    ],
)
def test_what_no_engine_can_start_is_refused(
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
    sections: dict[str, Any],
    found: str,
) -> None:
    monkeypatch.setattr(preparing, "why_no_sandbox", lambda *_: None)  # as where bubblewrap is installed
    config = write_config(tmp_path, **sections)

    assert found in refused(capsys, "render", "slurm", config, "--insecure")


@pytest.mark.parametrize(
    ("engine", "option"),
    [
        ("slurm", "--image=mine"),
        ("slurm", "--claim=mine"),
        ("compose", "--claim=mine"),
        ("kubernetes", "--slurm-option=-t1"),
    ],
)
def test_an_option_of_another_engine_is_refused(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], engine: str, option: str
) -> None:
    text = refused(capsys, "render", engine, write_config(tmp_path), "--insecure", option)

    assert text == f"`render {engine}` takes no {option.partition('=')[0]}"


@pytest.mark.parametrize("option", ["--output=x", "-n3", "--wait", "partition=x"])
def test_an_option_that_belongs_to_the_job_is_refused(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], option: str
) -> None:
    text = refused(capsys, "render", "slurm", write_config(tmp_path), "--insecure", f"--slurm-option={option}")

    assert "of `sbatch`" in text or "cannot be given to `sbatch`" in text


def identities(folder: Path, address: str) -> Authority:
    """An authority with a folder for the master at this address, and one for the nodes."""
    authority = Authority.made(folder)
    authority.add("master", "node", 1.0, [address])
    authority.add("node", "node", 1.0, [])
    return authority


def test_a_job_with_certificates_does_the_job_of_launch(place: Place) -> None:
    config = write_config(place.folder)
    identities(place.folder / "lab", os.uname().nodename)
    place.run("launch", config, "--local", "--output", "local.csv")
    render = place.run("render", "slurm", config, "--security", place.folder / "lab", "-o", "job")

    job = place.start_command(["sh", "job"])

    assert (render.wait(), job.wait()) == (0, 0), place.story()
    assert "insecure" not in (place.folder / "job").read_text()
    assert config.with_suffix(".csv").read_bytes() == (place.folder / "local.csv").read_bytes()


def test_a_key_that_others_can_read_is_refused(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    config = write_config(tmp_path)
    identities(tmp_path / "lab", "master")
    (tmp_path / "lab" / "node" / "key.pem").chmod(0o644)

    text = refused(capsys, "render", "slurm", config, "--security", tmp_path / "lab")

    assert "key.pem' (mode 644)" in text


def test_a_certificate_for_another_address_is_refused(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    config = main_job(tmp_path)
    identities(tmp_path / "lab", "elsewhere")

    text = refused(capsys, "render", "kubernetes", config, "--security", tmp_path / "lab")

    assert "listens as elsewhere, and the master is at master.pair" in text
    assert "lab master --host master.pair` adds it" in text


def test_the_services_of_compose_do_the_job_of_launch(place: Place, capsys: pytest.CaptureFixture[str]) -> None:
    config = main_job(place.folder)
    place.run("launch", config, "--local", "--output", "local.csv")
    services = yaml.safe_load(rendered(capsys, "compose", config, "--insecure"))["services"]
    port = free_port()

    def outside(word: str) -> str:
        word = re.sub(r"tcp/(pair-master|0\.0\.0\.0):7447", f"tcp/127.0.0.1:{port}", word)
        return re.sub(r"^/mesh\b", str(place.folder), word)

    started = {name: place.start(*map(outside, service["command"])) for name, service in services.items()}

    assert {name: launched.wait() for name, launched in started.items()} == dict.fromkeys(services, 0), place.story()
    assert (place.folder / "results" / "pair.csv").read_bytes() == (place.folder / "local.csv").read_bytes()


def test_a_compose_file_shows_each_container_only_its_files(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (models := tmp_path / "models").mkdir()
    instances: dict[str, dict[str, Any]] = {
        "Gain_1": {"fmu": str(models / "Gain.fmu"), "process": {"memory": "1 GiB"}},
        "master": {"fmu": "Gain"},
    }
    (models / "Gain.fmu").write_bytes((Path(__file__).parents[2] / "fmus" / "Gain.fmu").read_bytes())
    instances["master"] = {"fmu": str(models / "Gain.fmu")}
    (tmp_path / "configs").mkdir()
    config = write_config(
        tmp_path / "configs", instances=instances, connections=(), record={"file": "../results/$HOME.csv"}
    )
    identities(tmp_path / "lab", "pair-master")

    text = rendered(capsys, "compose", config, "--security", tmp_path / "lab", "--image", "registry/mine:1.2")
    whole = yaml.safe_load(text)

    services = whole["services"]
    assert {name: service["command"][0] for name, service in services.items()} == {
        "master": "master",
        "gain-1": "node",
        "master-2": "node",
    }
    assert services["master"]["container_name"] == "pair-master"
    assert "tls/pair-master:7447" in services["gain-1"]["command"]
    assert services["master"]["depends_on"] == ["gain-1", "master-2"]
    assert {service["image"] for service in services.values()} == {"registry/mine:1.2"}
    assert {service["user"] for service in services.values()} == {f"{os.getuid()}:{os.getgid()}"}
    assert services["gain-1"]["mem_limit"] == (1 << 30) + (256 << 20)
    assert "mem_limit" not in services["master-2"]
    assert whole["networks"] == {"mesh": {"internal": True}}
    assert {service["restart"] for service in services.values()} == {"no"}
    assert [(one["source"], one["target"], one["read_only"]) for one in services["master"]["volumes"]] == [
        (str(tmp_path), "/mesh", True),
        (str(tmp_path / "results"), "/mesh/results", False),
        (str(tmp_path / "lab" / "master"), "/security", True),
    ]
    assert [(one["source"], one["target"], one["read_only"]) for one in services["gain-1"]["volumes"]] == [
        (str(tmp_path), "/mesh", True),
        (str(tmp_path / "lab" / "node"), "/security", True),
    ]
    assert "insecure" not in text


@pytest.mark.skipif(not all(map(shutil.which, ("podman", "podman-compose"))), reason="podman-compose is not installed")
def test_podman_compose_starts_what_the_file_says(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    config = main_job(tmp_path, memory="512 MiB")
    (tmp_path / "compose.yaml").write_text(rendered(capsys, "compose", config, "--insecure"), encoding="utf-8")
    command = ["podman-compose", "--dry-run", "-f", "compose.yaml", "run", "--rm", "--name", "pair-master", "master"]
    # Also a dry run makes the network.
    (settings := tmp_path / "podman.conf").write_text(f'[network]\nnetwork_config_dir = "{tmp_path}"\n')
    monkeypatch.setenv("CONTAINERS_CONF", str(settings))

    # Debian's has no `config`: this shows the commands of Podman.
    shown = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, check=True, timeout=DEADLINE_S)

    lines = [shlex.split(line) for line in (shown.stdout + shown.stderr).splitlines() if line.startswith("podman run ")]
    ends = {tuple(words[words.index("fmu-mesh") :]) for words in lines}
    assert ends == {
        ("fmu-mesh", "master", "/mesh/pair.yaml", "--listen", "tcp/0.0.0.0:7447", "--no-progress", "--insecure"),
        *(
            ("fmu-mesh", "node", "/mesh/pair.yaml", node, "--connect", "tcp/pair-master:7447", "--insecure")
            for node in ("pendulum", "delay")
        ),
    }
    assert all(f"{tmp_path}:/mesh:ro" in words for words in lines)
    assert [f"{tmp_path}/results:/mesh/results:rw" in words for words in lines] == [
        "master" in words for words in lines
    ]
    assert ["--name=pair-master" in words for words in lines] == ["master" in words for words in lines]
    memory = str((512 << 20) + (256 << 20))
    assert [memory in words for words in lines] == ["pendulum" in words for words in lines]
    assert all({"--cap-drop", "ALL", "no-new-privileges:true"} <= {*words} for words in lines)


def test_files_all_over_the_host_are_not_for_containers(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(Path, "home", lambda: tmp_path)

    text = refused(
        capsys,
        "render",
        "compose",
        write_config(tmp_path, instances={"a": {"fmu": "Gain"}}, connections=()),
        "--insecure",
    )

    assert "are together only in '" in text


def documents(text: str) -> list[dict[str, Any]]:
    return list(yaml.safe_load_all(text))


@pytest.mark.parametrize("secured", [False, True])
@pytest.mark.parametrize("version", ["1.29", "1.31", "1.34"])
def test_manifests_follow_the_schemas_of_kubernetes(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], version: str, *, secured: bool
) -> None:
    config = main_job(tmp_path)
    identities(tmp_path / "lab", "master.pair")
    access = ("--security", tmp_path / "lab") if secured else ("--insecure",)

    found = documents(rendered(capsys, "kubernetes", config, *access))

    assert [one["kind"] for one in found] == ["Service", "Job", "Job", "Job"]
    for one in found:
        kubernetes_validate.validate(one, version, strict=True)


def test_the_schemas_find_a_wrong_manifest(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    job = documents(rendered(capsys, "kubernetes", main_job(tmp_path), "--insecure"))[1]
    job["spec"]["podFailurePolicy"]["rules"][0]["onExitCodes"]["values"] = ["three"]

    with pytest.raises(kubernetes_validate.ValidationError):
        kubernetes_validate.validate(job, "1.31", strict=True)


def test_jobs_have_limits_policies_and_secrets(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    config = main_job(tmp_path, memory="512 MiB")
    identities(tmp_path / "lab", "master.pair")

    text = rendered(capsys, "kubernetes", config, "--security", tmp_path / "lab", "--claim", "lab-data")
    service, *jobs = documents(text)

    pods = {job["metadata"]["name"]: job["spec"]["template"]["spec"] for job in jobs}
    assert [*pods] == ["pair-master", "pair-pendulum", "pair-delay"]
    assert (pods["pair-master"]["hostname"], pods["pair-master"]["subdomain"]) == ("master", "pair")
    assert service["metadata"]["name"] == "pair"
    assert service["spec"]["clusterIP"] == "None"
    assert service["spec"]["selector"].items() <= jobs[0]["spec"]["template"]["metadata"]["labels"].items()
    assert not service["spec"]["selector"].items() <= jobs[1]["spec"]["template"]["metadata"]["labels"].items()
    for job in jobs:
        rules = job["spec"]["podFailurePolicy"]["rules"]
        assert [rule["onExitCodes"]["values"] for rule in rules if rule["action"] == "FailJob"] == [[2, 3]]
    for name, pod in pods.items():
        [container] = pod["containers"]
        assert pod["restartPolicy"] == "Never"
        assert pod["securityContext"]["runAsNonRoot"] is True
        assert container["securityContext"]["capabilities"] == {"drop": ["ALL"]}
        assert container["securityContext"]["readOnlyRootFilesystem"] is True
        secret = next(volume["secret"]["secretName"] for volume in pod["volumes"] if "secret" in volume)
        assert secret == ("pair-master" if name == "pair-master" else "pair-node")
        assert "lab-data" in str(pod["volumes"])
        written = [one["mountPath"] for one in container["volumeMounts"] if not one.get("readOnly")]
        assert written[1:] == (["/mesh/results"] if name == "pair-master" else [])
        assert container["args"][-2:] == ["--security", "/security"]
    memory = str((512 << 20) + (256 << 20))
    assert pods["pair-pendulum"]["containers"][0]["resources"] == {
        "requests": {"cpu": "1", "memory": memory},
        "limits": {"memory": memory},
    }
    assert "limits" not in pods["pair-delay"]["containers"][0]["resources"]
    for role in ("master", "node"):
        assert re.search(
            rf"#   kubectl create secret generic pair-{role} --from-file=\S*lab/{role}$", text, re.MULTILINE
        )
        assert (tmp_path / "lab" / role / "key.pem").read_text().splitlines()[1] not in text


@given(st.lists(st.from_regex(r"[A-Za-z_][A-Za-z0-9_-]{0,60}", fullmatch=True), unique=True, max_size=8))
def test_names_for_engines_are_names_of_dns(words: list[str]) -> None:
    names = names_for(words, most=25)

    assert len({*names}) == len(words)
    assert all(re.fullmatch(r"[a-z]([a-z0-9-]{0,28}[a-z0-9])?", name) for name in names)


def test_options_are_forwarded_as_they_were_meant(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    config = write_config(tmp_path)
    given_words = ["--set", "pendulum.a=-1e-3", "--set-config", "timeouts={step: 3, start: 1.5}", "--window", "auto"]

    script = rendered(capsys, "slurm", config, "--insecure", *given_words, "--output", "its.csv")

    [line] = [line for line in script.splitlines() if " fmu_mesh master " in line]
    words = shlex.split(line)
    assert words[words.index("--set") + 1] == "pendulum.a=-0.001"
    assert words[words.index("--set-config") + 1] == 'timeouts={"step": 3, "start": 1.5}'
    assert words[words.index("--output") + 1] == str(Path.cwd() / "its.csv")
    assert words[:3] == [sys.executable, "-Pm", "fmu_mesh"]
