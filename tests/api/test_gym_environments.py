"""`fmu_mesh.gym`: a mesh is what Gymnasium asks of an environment, and has the floats of a run."""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Callable, Iterator
from contextlib import closing
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import pytest
from gymnasium.spaces import Box, Discrete, MultiDiscrete
from gymnasium.utils.env_checker import check_env
from gymnasium.vector import AutoresetMode, SyncVectorEnv
from gymnasium.wrappers.vector import ClipReward, NormalizeObservation, RecordEpisodeStatistics
from msgspec.structs import replace
from numpy.typing import NDArray

import fmu_mesh
from fmu_mesh.gym import MeshEnv, MeshVectorEnv, Step, Task

ROOT = Path(__file__).resolve().parents[2]
CART_POLE = ROOT / "configs" / "cart_pole.yaml"
STATE = ("cart.x", "cart.der(x)", "cart.theta", "cart.der(theta)")

TASK = Task(
    mesh=CART_POLE,
    observations={"cart.x": (-4.8, 4.8), "cart.der(x)": (-9, 9), "cart.theta": (-3, 3), "cart.der(theta)": (-9, 9)},
    actions={"cart.force": (-10.0, 10.0)},
    reward=lambda step: 1.0 - step["cart.theta"] ** 2 - 1e-4 * step["cart.force"] ** 2,
    terminated=lambda step: np.abs(step["cart.theta"]) > 0.8,
    dtype=np.float64,
)
"""All episodes begin as the mesh does."""


def drawn(random: np.random.Generator, copies: int) -> dict[str, Any]:
    return {name: random.uniform(-0.1, 0.1, copies) for name in STATE}


DRAWN = replace(TASK, start_values=drawn)

PARTS = """
import fmu_mesh
from fmu_mesh import Input, Output


class Machine(fmu_mesh.Component):
    gear = Input(type="Int32")
    level = Input(type="Int32")
    brake = Input(type="Boolean")
    share = Input()
    speed = Output()
    number = Output(type="Int32")
    moves = Output(type="Boolean")
    field = Output(shape=(2, 3))
    word = Output(type="String")

    def step(self, time, step_size):
        power = self.gear + 10.0 * self.level + 100.0 * self.share
        self.speed = self.speed + step_size * (0.0 if self.brake else power)
        self.number = self.number + 1
        self.moves = self.speed > 0.0
        self.field = self.field + self.speed
"""


@pytest.fixture
def machine(tmp_path: Path) -> fmu_mesh.Mesh:
    """A mesh with a component that has inputs and outputs of several types."""
    (tmp_path / "parts.py").write_text(PARTS, encoding="utf-8")
    text = "mesh: machines\nsimulation: {stop_time: 1.0, step_size: 0.1}\n"
    text += "instances: {it: {python: 'parts.py:Machine'}}\n"
    return fmu_mesh.Mesh.from_yaml(text, folder=tmp_path)


Maker = Callable[..., MeshVectorEnv]


@pytest.fixture
def vector() -> Iterator[Maker]:
    """Makes vector environments, which are closed at the end."""
    made: list[MeshVectorEnv] = []

    def make(task: Task, num_envs: int, **options: Any) -> MeshVectorEnv:  # noqa: ANN401  as the environment takes them
        made.append(MeshVectorEnv(task, num_envs, **options))
        return made[-1]

    yield make
    for one in made:
        one.close()


def total(step: Step) -> Any:  # noqa: ANN401  an array
    return step["it.speed"] - step.before["it.speed"]


@pytest.mark.parametrize("task", [TASK, DRAWN, replace(DRAWN, points=3, dtype=np.float32)])
def test_an_environment_is_what_gymnasium_asks_of_one(task: Task) -> None:
    with closing(MeshEnv(task)) as environment:
        check_env(environment, skip_render_check=True)

        assert environment.action_space == Box(-1.0, 1.0, (1,), np.float32)
        assert environment.observation_space.dtype == task.dtype


@pytest.mark.parametrize("actions", [["it.brake"], {"it.gear": (-2, 3), "it.brake": None, "it.level": (0, 1)}])
def test_an_environment_with_whole_actions_is_one_too(machine: fmu_mesh.Mesh, actions: Any) -> None:  # noqa: ANN401  of two types
    observations = {"it.speed": (-99, 99), "it.number": (0, 10), "it.moves": None, "it.field": (-999, 999)}
    with closing(MeshEnv(Task(mesh=machine, observations=observations, actions=actions, reward=total))) as environment:
        check_env(environment, skip_render_check=True)

        expected = Discrete(2) if len(actions) == 1 else MultiDiscrete([6, 2, 2], start=[-2, 0, 0])
        assert environment.action_space == expected
        assert environment.observation_space.shape == (9,)


def test_whole_actions_and_arrays_have_their_values(machine: fmu_mesh.Mesh, vector: Maker) -> None:
    task = Task(
        mesh=machine,
        observations=["it.field", "it.number", "it.speed"],
        actions={"it.gear": (-2, 3), "it.brake": None, "it.level": (0, 1)},
        reward=lambda step: step["it.field"].sum(axis=(1, 2)) + step["it.gear"],
    )
    environments = vector(task, 3)
    environments.reset(seed=1)

    seen, rewards, *_ = environments.step(np.array([[-2, 0, 0], [3, 0, 1], [3, 1, 1]]))

    speeds = np.array([-0.2, 1.3, 0.0])
    expected = np.column_stack([*[speeds] * 6, np.ones(3), speeds])
    assert np.abs(seen - expected).max() < 1e-6
    assert np.abs(rewards - 6.0 * speeds - [-2.0, 3.0, 3.0]).max() < 1e-12


def test_many_copies_equal_single_environments_in_every_float(vector: Maker) -> None:
    copies, random = 5, np.random.default_rng(7)
    task = replace(TASK, episode_time=0.6)
    environments = vector(task, copies)
    singles = SyncVectorEnv([lambda: MeshEnv(task)] * copies)
    ends = np.zeros(2, dtype=int)

    with closing(singles):
        assert environments.reset()[0].tolist() == singles.reset()[0].tolist()
        for _ in range(300):
            actions = random.uniform(-1.5, 1.0, (copies, 1))
            one, other = environments.step(actions), singles.step(actions)
            assert [part.tolist() for part in one[:4]] == [part.tolist() for part in other[:4]]
            ends += [one[2].sum(), one[3].sum()]

        assert environments.observation_space == singles.observation_space
        assert environments.action_space == singles.action_space
    assert ends.min() > 10  # episodes fell, and others were cut off


def test_an_episode_has_the_floats_of_a_run(vector: Maker) -> None:
    pushes = np.random.default_rng(3).uniform(-0.2, 0.2, (20, 1))
    environments = vector(DRAWN, 1)
    seen = [environments.reset(seed=5)[0][0]]
    seen += [environments.step(push[None])[0][0] for push in pushes]

    start = dict(zip(STATE, seen[0].tolist(), strict=True))
    mesh = fmu_mesh.load(CART_POLE)
    times = (0.02 * np.arange(20)).tolist()
    forces = (-10.0 + (pushes[:, 0] + 1.0) * 10.0).tolist()
    mesh.scenario({"cart.force": {"times": times, "values": forces}})
    result = mesh.run(record="memory", stop_time=0.4, start_values=start, output=None)

    assert np.array(seen).T.tolist() == [result[name].tolist() for name in STATE]


def test_an_action_holds_for_its_points(vector: Maker) -> None:
    one, other = vector(DRAWN, 2), vector(replace(DRAWN, points=5), 2)
    assert one.reset(seed=1)[0].tolist() == other.reset(seed=1)[0].tolist()

    for push in (-0.3, 0.2):
        action = np.full((2, 1), push)
        seen = [one.step(action)[0] for _ in range(5)][-1]
        assert other.step(action)[0].tolist() == seen.tolist()


def test_the_step_size_is_an_option(vector: Maker) -> None:
    environments = vector(replace(TASK, reward=lambda step: step.time), 2, step_size=0.005)
    environments.reset()

    assert environments.step(np.zeros((2, 1)))[1].tolist() == [0.005, 0.005]


@pytest.mark.parametrize(
    ("points", "episode_time", "options", "steps"),
    [
        (1, 0.1, {}, 5),
        (1, None, {"stop_time": 0.14}, 7),
        (3, None, {"stop_time": 0.14}, 2),  # a third action would end after the stop time
        (3, 0.18, {"stop_time": 0.3}, 3),
        (1, 5.0, {"stop_time": 0.14}, 7),
    ],
)
def test_an_episode_is_truncated_when_its_time_is_up(
    vector: Maker, points: int, episode_time: float | None, options: dict[str, float], steps: int
) -> None:
    task = replace(TASK, points=points, episode_time=episode_time)
    environments = vector(task, 2, **options)
    first = environments.reset()[0].tolist()

    for _ in range(2):
        for step in range(1, steps + 1):
            _, rewards, terminated, truncated, _ = environments.step(np.zeros((2, 1)))
            assert (truncated.tolist(), terminated.tolist()) == ([step == steps] * 2, [False] * 2)
            assert rewards.min() > 0.9
        seen, rewards, terminated, truncated, _ = environments.step(np.ones((2, 1)))
        assert (seen.tolist(), rewards.tolist()) == (first, [0.0, 0.0])
        assert not (terminated | truncated).any()


def test_one_seed_gives_the_same_episodes_again(vector: Maker) -> None:
    environments, random = vector(replace(DRAWN, episode_time=0.1), 4), np.random.default_rng(1)
    actions = random.uniform(-1.0, 1.0, (20, 4, 1))

    def episodes(seed: int | None) -> list[Any]:
        seen = [environments.reset(seed=seed)[0].tolist()]
        return seen + [environments.step(action)[0].tolist() for action in actions]

    first = episodes(5)
    assert episodes(5) == first
    assert episodes(6) != first
    later = episodes(None)
    episodes(6)
    assert episodes(None) == later
    assert len({tuple(start) for start in first[0]}) == 4  # each copy has a start of its own


def test_start_values_can_be_given(vector: Maker) -> None:
    environments = vector(DRAWN, 2)

    seen, _ = environments.reset(seed=1, options={"cart.theta": [0.3, -0.3], "cart.x": 1.5})

    assert seen[:, [0, 2]].tolist() == [[1.5, 0.3], [1.5, -0.3]]
    assert seen[:, 1].tolist() == environments.reset(seed=1)[0][:, 1].tolist()
    with closing(MeshEnv(DRAWN)) as environment:
        assert environment.reset(options={"cart.theta": 0.3})[0][2] == 0.3
        with pytest.raises(fmu_mesh.FmuMeshError, match="tetha"):
            environment.reset(options={"cart.tetha": 0.3})


def test_several_fmus_are_one_environment(vector: Maker) -> None:
    mesh = fmu_mesh.Mesh("pair", step_size=0.01, stop_time=1.0)
    mesh.add("gain", fmu=str(ROOT / "fmus" / "Gain.fmu"), start_values={"k": 2.0})
    mesh.add("tank", fmu=str(ROOT / "fmus" / "Integrator.fmu"))
    mesh.connect("gain.y", "tank.u")
    task = Task(
        mesh=mesh,
        observations=["tank.y", "gain.y"],
        actions={"gain.u": (0.0, 4.0), "gain.k": (1.0, 3.0)},
        reward=lambda step: (step["tank.y"] - step.before["tank.y"]) / 0.01 + step["tank.k"],
        scaled=False,
    )
    environments = vector(task, 2)
    environments.reset()

    seen, rewards, *_ = environments.step(np.array([[0.5, 2.0], [7.0, 1.0]]))  # 7 counts as 4

    assert environments.single_action_space == Box(np.array([0, 1], np.float32), np.array([4, 3], np.float32))
    assert seen[:, 1].tolist() == [1.0, 4.0]
    assert np.abs(rewards - [2.0, 5.0]).max() < 1e-9


def test_an_fmu_that_fails_ends_its_own_episode_only(vector: Maker) -> None:
    task = replace(TASK, actions={"cart.l": (1e-9, 1.0)}, scaled=False)  # so short that it is refused
    environments = vector(task, 3)
    first = environments.reset()[0]

    _, _, terminated, truncated, infos = environments.step(np.array([[1.0], [0.0], [1.0]]))
    assert (terminated.tolist(), truncated.tolist()) == ([False, True, False], [False] * 3)
    assert infos["_reason"].tolist() == [False, True, False]
    assert "cart" in infos["reason"][1]

    seen, rewards, terminated, _, infos = environments.step(np.ones((3, 1)))
    assert (seen[1].tolist(), rewards[1]) == (first[1].tolist(), 0.0)
    assert (terminated.tolist(), infos) == ([False] * 3, {})
    assert seen[0].tolist() == seen[2].tolist() != seen[1].tolist()
    assert not environments.step(np.ones((3, 1)))[2].any()
    with closing(MeshEnv(task)) as environment:
        environment.reset()
        *_, info = environment.step(np.array([0.0]))
        assert list(info) == ["reason"]


def test_gymnasium_makes_registered_meshes_and_wraps_them() -> None:
    gymnasium.register(
        "CartPoleOfMesh-v0",
        entry_point="fmu_mesh.gym:MeshEnv",
        vector_entry_point="fmu_mesh.gym:MeshVectorEnv",
        kwargs={"task": DRAWN},
    )
    try:
        with closing(gymnasium.make("CartPoleOfMesh-v0", max_episode_steps=20)) as environment:
            environment.reset(seed=1)
            steps = 0
            over = False
            while not over:
                _, _, terminated, truncated, _ = environment.step(environment.action_space.sample())
                over, steps = terminated or truncated, steps + 1
            assert 0 < steps <= 20
        made = gymnasium.make_vec("CartPoleOfMesh-v0", 4, vectorization_mode="vector_entry_point")
        with closing(RecordEpisodeStatistics(ClipReward(NormalizeObservation(made), 0.0, 0.5))) as environments:
            assert environments.metadata["autoreset_mode"] is AutoresetMode.NEXT_STEP
            environments.reset(seed=1)
            lengths: list[int] = []
            while len(lengths) < 8:
                *_, infos = environments.step(environments.action_space.sample())
                lengths += infos["episode"]["l"][infos["_episode"]].tolist() if "episode" in infos else []
        assert min(lengths) > 1
    finally:
        gymnasium.registry.pop("CartPoleOfMesh-v0")


def test_calls_out_of_order_are_refused(vector: Maker) -> None:
    environments, environment = vector(replace(TASK, episode_time=0.02), 2), MeshEnv(replace(TASK, episode_time=0.02))
    for one, action in ((environments, np.zeros((2, 1))), (environment, np.zeros(1))):
        with pytest.raises(gymnasium.error.ResetNeeded):
            one.step(action)
        one.reset()
        one.step(action)
    with pytest.raises(gymnasium.error.ResetNeeded):
        environment.step(np.zeros(1))  # its only episode is over
    for one, action in ((environments, np.zeros((2, 1))), (environment, np.zeros(1))):
        one.close()
        one.close()
        with pytest.raises(gymnasium.error.ClosedEnvironmentError):
            one.step(action)
        with pytest.raises(gymnasium.error.ClosedEnvironmentError):
            one.reset()


@pytest.mark.parametrize(
    ("changes", "expected"),
    [
        ({"observations": ["cart.tetha"]}, "tetha"),
        ({"observations": []}, "observations of the task: expected one variable or more"),
        ({"actions": ["cart.force"]}, "'cart.force' has no minimum and maximum"),
        ({"actions": {"cart.force": (1.0, 1.0)}}, "the bounds of 'cart.force' are 1 and 1"),
        ({"actions": {"cart.x": (0.0, 1.0)}}, "x"),
        ({"points": 0}, "points"),
        ({"episode_time": 0.0}, "episode_time"),
    ],
)
def test_a_task_that_cannot_be_done_is_refused(changes: dict[str, Any], expected: str) -> None:
    with pytest.raises(fmu_mesh.FmuMeshError, match=expected):
        MeshEnv(replace(TASK, **changes))


def test_a_task_of_words_or_of_mixed_actions_is_refused(machine: fmu_mesh.Mesh) -> None:
    task = Task(mesh=machine, observations=["it.speed"], actions=["it.brake"], reward=total)
    for changes, expected in (
        ({"observations": ["it.word"]}, "'it.word' is a String"),
        ({"actions": {"it.brake": None, "it.share": (0.0, 1.0)}}, "it.brake of the actions has whole numbers"),
        ({"actions": ["it.gear"]}, "'it.gear' has no minimum and maximum"),
    ):
        with pytest.raises(fmu_mesh.CallRefused, match=expected):
            MeshEnv(replace(task, **changes))


@pytest.mark.parametrize(
    ("changes", "action", "expected"),
    [
        ({"reward": lambda _: np.zeros((2, 2))}, np.zeros((2, 1)), r"`reward` .* \(2, 2\); expected \(2,\)"),
        ({"terminated": lambda _: np.zeros(3)}, np.zeros((2, 1)), r"`terminated` .* \(3,\); expected \(2,\)"),
        ({}, np.zeros((2, 3)), "an action has 3 elements; expected 1"),
        ({}, np.full((2, 1), np.nan), "force"),
    ],
)
def test_a_step_that_cannot_be_taken_is_refused(
    vector: Maker, changes: dict[str, Any], action: NDArray[Any], expected: str
) -> None:
    environments = vector(replace(TASK, **changes), 2)
    environments.reset()

    with pytest.raises(fmu_mesh.CallRefused, match=expected):
        environments.step(action)


def test_whole_actions_out_of_bounds_are_refused(machine: fmu_mesh.Mesh, vector: Maker) -> None:
    task = Task(mesh=machine, observations=["it.speed"], actions={"it.gear": (0, 3)}, reward=total)
    environments = vector(task, 2)
    environments.reset()

    with pytest.raises(fmu_mesh.CallRefused, match=r"an action has \[4\] for 'it.gear'; expected 0 to 3"):
        environments.step(np.array([0, 4]))


def test_only_the_environments_import_gymnasium() -> None:
    program = "import sys, fmu_mesh; fmu_mesh.load; fmu_mesh.System; assert 'gymnasium' not in sys.modules"
    subprocess.run([sys.executable, "-c", program], check=True, timeout=60)

    missing = """
import sys
sys.modules["gymnasium"] = None
import fmu_mesh
try:
    import fmu_mesh.gym
except fmu_mesh.LibraryMissing as error:
    print(error)
"""
    done = subprocess.run([sys.executable, "-c", missing], check=True, timeout=60, capture_output=True, text=True)
    assert "environments of Gymnasium need the library gymnasium" in done.stdout
