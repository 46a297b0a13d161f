"""A world computed by MuJoCo behind the `Instance` Protocol.

One own step from n to n + 1, in pseudocode::

    inputs of row n
    applied effort of every joint = effort, plus effort_command if the joint has no actuator; limited
    physics_steps times:
        force and moment of every driven body, turned into world axes and moved to its centre of mass
        mj_step
    refresh what is read at the point: positions, velocities, sensors
    outputs into row n + 1

All efforts and forces are set anew in every step; none remains from the step before. Positions and velocities are those
of the point; accelerations and forces are those of the engine's last step. Variables and their names are
`fmu_mesh.instances.mujoco.mujoco_world`, changes of axes `fmu_mesh.instances.body_axes`.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ...errors import InitializationFailed, StepFailed
from ...rings.ring import Ring
from ...simtime import TimeGrid, steps_between
from ...variables.model_description import Value
from ..body_axes import relative_velocity, to_body, wrench_at_center
from ..contract import KeepsStateAsBytes, LogMessage
from ..world_variables import STATE, WorldVariable
from .mujoco_section import MujocoConfig
from .mujoco_world import engine, load_world, warnings
from .rendering import Picture

__all__ = ["MujocoInstance"]

Floats = NDArray[np.float64]

_OF_VELOCITIES = frozenset({"linear_velocity", "angular_velocity", "body_wind", "relative_velocity"})
_SELDOM = frozenset({"body_linear_velocity", "body_angular_velocity", "state"})
"""These take more time, so they are computed only for the bodies of which one is read."""
_OF_JOINTS = frozenset({"position", "velocity", "acceleration", "effort_applied", "actuator_force"})
"""These are up to date after a step."""
_INPUTS = frozenset({"effort", "effort_command", "wrench", "control", "wind"})


class MujocoInstance(KeepsStateAsBytes):
    """One world; see `fmu_mesh.instances.contract.Instance` for the call sequence."""

    def __init__(
        self,
        path: Path,
        name: str,
        config: MujocoConfig,
        log: Callable[[LogMessage], None] = lambda _message: None,
        picture: Picture | None = None,
    ) -> None:
        self.name = name
        self._mujoco = engine()
        self._world = world = load_world(path, config)
        self.description = world.description
        self._config = config
        self._log = log
        self._picture = picture
        self._model = world.model
        # An unstable world is an error; by default, MuJoCo would start it again from the beginning.
        self._model.opt.disableflags |= int(self._mujoco.mjtDisableBit.mjDSBL_AUTORESET)
        self._timestep = float(self._model.opt.timestep)
        self._wind = np.array(self._model.opt.wind, dtype=np.float64)
        self._entries = {entry.variable.name: entry for entry in world.entries}
        self._closed = False
        self._begin()
        self._set_limits()

    def end_run(self) -> bool:
        """See `BeginsAgain`; a film has one beginning."""
        return self._picture is None

    def begin_again(self) -> None:
        """See `BeginsAgain`."""
        self._model.opt.timestep = self._timestep
        self._model.opt.wind[:] = self._wind
        self._begin()

    def _begin(self) -> None:
        """Be in the state of the model."""
        self._data = data = self._mujoco.MjData(self._model)
        self._step = 0
        bodies, dofs = self._model.nbody, self._model.nv
        self._own: dict[str, Floats] = {
            "acceleration": np.zeros(dofs),
            "effort_applied": np.zeros(dofs),
            "effort_command": np.zeros(dofs),
            "effort": np.zeros(dofs),
            "wrench": np.zeros(6 * bodies),
            "control": np.zeros(self._model.nu),
            "wind": self._wind.copy(),
            **{what: np.zeros(3 * bodies) for what in _OF_VELOCITIES | _SELDOM},
            "state": np.zeros(STATE * bodies),
        }
        self._arrays: dict[str, Floats] = {
            **self._own,
            "position": data.qpos,
            "velocity": data.qvel,
            "body_position": data.xpos.reshape(-1),
            "body_orientation": data.xquat.reshape(-1),
            "sensor": data.sensordata,
            "actuator_force": data.actuator_force,
        }
        # MuJoCo's own memory, looked up once, because each access to such an attribute makes an array.
        self._memory: dict[str, Floats] = {
            **{name: getattr(data, name) for name in ("qfrc_applied", "xfrc_applied", "ctrl", "qacc")},
            "wind": self._model.opt.wind,
        }
        self._driven: tuple[int, ...] = ()
        self._bound = False

    def enter_initialization(
        self, start_time: float, stop_time: float | None, start_values: Mapping[str, Value]
    ) -> None:
        """Start from the keyframe or the model's own position, then set ``start_values`` (time in s)."""
        if self._world.keyframe is not None:
            self._mujoco.mj_resetDataKeyframe(self._model, self._data, self._world.keyframe)
            self._own["control"][:] = self._data.ctrl
        self._data.time = start_time
        self.set_values(start_values)

    def exit_initialization(self) -> None:
        """Compute the outputs of the first point: positions, velocities, and sensors, without any effort."""
        warnings.clear()
        self._model.opt.wind[:] = self._own["wind"]
        self._mujoco.mj_forward(self._model, self._data)
        if warnings:
            raise InitializationFailed(f"MuJoCo says: {' '.join(warnings[0].split())}", instance=self.name)

    def set_values(self, values: Mapping[str, Value]) -> None:
        """Set inputs and free bodies by name, and before the first point positions and velocities of joints."""
        for name, value in values.items():
            entry = self._entries[name]
            if entry.where == "state":
                self._place(*divmod(entry.index, STATE), np.array(value, dtype=np.float64))
                continue
            self._arrays[entry.where][entry.index] = value
            if entry.where == "effort_command" and not self._direct[entry.index] and self._bound:
                text = f"'{name}' was set, but the joint has an actuator: set the actuator's own input"
                self._warn(text)
        self._drive(self._entries[name] for name in values)

    def get_values(self, names: Sequence[str]) -> list[Value]:
        """Current values of variables by name."""
        entries = [self._entries[name] for name in names]
        self._refresh(sensors=any(entry.where == "sensor" for entry in entries), bodies=_bodies_of(entries))
        found = [self._arrays[entry.where][entry.index :][: entry.variable.size].tolist() for entry in entries]
        return [own if entry.variable.shape else own[0] for entry, own in zip(entries, found, strict=True)]

    def bind(self, inputs: Ring, outputs: Sequence[Ring], grid: TimeGrid, points: int, step: int = 0) -> None:
        """Let `do_step` work on these rings, ``points`` of ``grid`` each; write the current outputs as row ``step``."""
        self._start_time, self._points, self._base = grid.start_time, points, grid.step_size
        step_size, longest = points * grid.step_size, self._timestep
        fewest = max(1, steps_between(0.0, step_size, longest) or math.ceil(step_size / longest))
        self._substeps = self._config.physics_steps or fewest
        self._model.opt.timestep = step_size / self._substeps
        self._step, self._last_step = step, grid.last_point // points
        self._inputs = inputs
        taken = [self._entries[name] for name in inputs.layout.names]
        self._takes = _grouped(taken)
        self._drive(taken)
        read = [self._entries[name] for ring in outputs for name in ring.layout.names]
        self._outputs = [(ring, _grouped([self._entries[name] for name in ring.layout.names])) for ring in outputs]
        self._reads = any(entry.where not in _OF_JOINTS for entry in read)
        self._reads_sensors = any(entry.where == "sensor" for entry in read)
        self._reads_bodies = _bodies_of(read)
        self._finish(step)
        self._bound = True

    def do_step(self, step: int) -> None:
        """Take the inputs of row ``step``, advance to own step ``step + 1``, write the outputs to row ``step + 1``."""
        row = self._inputs.part("Float64")[step & self._inputs.mask]
        for where, places, columns in self._takes:
            self._arrays[where][places] = row[columns]
        self._data.time = self._start_time + step * self._points * self._base
        self._apply()
        warnings.clear()
        for _ in range(self._substeps):
            if self._driven:
                self._push()
            self._mujoco.mj_step(self._model, self._data)
            if warnings:
                self._look_at_warnings()
        self._step = step + 1
        self._own["acceleration"][:] = self._memory["qacc"]
        self._finish(step + 1)

    def get_state(self) -> bytes:
        """See `KeepsState`: everything that the next steps and the outputs of this point depend on."""
        mujoco = self._mujoco
        size = mujoco.mj_stateSize(self._model, mujoco.mjtState.mjSTATE_INTEGRATION)
        state = np.zeros(size)
        mujoco.mj_getState(self._model, self._data, state, mujoco.mjtState.mjSTATE_INTEGRATION)
        return b"".join(part.tobytes() for part in (state, *self._remembered()))

    def set_state(self, state: object) -> None:
        """See `KeepsState`; also for a state of an equal instance."""
        assert isinstance(state, bytes)
        mujoco = self._mujoco
        kept = self._remembered()
        size = mujoco.mj_stateSize(self._model, mujoco.mjtState.mjSTATE_INTEGRATION)
        values = np.frombuffer(state, np.float64) if len(state) % 8 == 0 else np.zeros(0)
        if len(values) != size + sum(part.size for part in kept):
            raise StepFailed(f"{len(state)} bytes are no state of this world", instance=self.name)
        mujoco.mj_setState(self._model, self._data, values[:size].copy(), mujoco.mjtState.mjSTATE_INTEGRATION)
        mujoco.mj_forward(self._model, self._data)
        # `mj_forward` has overwritten the warm start and what belongs to the last step.
        mujoco.mj_setState(self._model, self._data, values[:size].copy(), mujoco.mjtState.mjSTATE_INTEGRATION)
        for part in kept:
            part[...] = values[size : size + part.size].reshape(part.shape)
            size += part.size
        acting = np.flatnonzero(self._own["wrench"]) // 6
        self._driven = tuple(sorted({*self._driven, *acting.tolist()}))

    def close(self) -> None:
        """End the film or window. Never raises; may be called twice."""
        if not self._closed and self._picture is not None:
            self._picture.close()
        self._closed = True

    # --- what is applied

    def _set_limits(self) -> None:
        """The constants of joint efforts: limits, and which joints have an actuator."""
        dofs = self._model.nv
        self._least, self._most = np.full(dofs, -math.inf), np.full(dofs, math.inf)
        for dof, lower, upper in self._world.limits:
            self._least[dof], self._most[dof] = lower, upper
        self._direct = np.ones(dofs, dtype=bool)
        for actuator in self._config.actuators:
            entry = self._entries.get(f"{actuator.joint}.effort")
            if actuator.enabled and entry is not None:
                self._direct[entry.index] = False
        self._limited = bool(self._world.limits)

    def _drive(self, entries: Iterable[WorldVariable]) -> None:
        """From now on, every step applies forces and moments of the bodies of these variables."""
        bodies = {entry.index // 6 for entry in entries if entry.where == "wrench"}
        self._driven = tuple(sorted({*self._driven, *bodies}))

    def _place(self, body: int, first: int, numbers: Floats) -> None:
        """Set the state of a free body from its number ``first`` on; the others stay, as they are in world axes."""
        self._refresh(sensors=False, bodies={body: True})
        state, joint = self._own["state"][STATE * body :][:STATE], self._model.body_jntadr[body]
        state[first:][: len(numbers)] = numbers
        self._mujoco.mju_normalize4(state[3:7])
        rotation = np.zeros(9)
        self._mujoco.mju_quat2Mat(rotation, state[3:7])
        self._data.qpos[self._model.jnt_qposadr[joint] :][:7] = state[:7]
        angular = to_body(rotation.tolist(), state[10:].tolist())  # MuJoCo has it in body axes
        self._data.qvel[self._model.jnt_dofadr[joint] :][:6] = (*state[7:10], *angular)

    def _apply(self) -> None:
        """Apply what is constant during an own step: efforts of joints, controls of the model's actuators, the wind."""
        own, memory = self._own, self._memory
        effort = own["effort"] + np.where(self._direct, own["effort_command"], 0.0)
        if self._limited:
            effort = np.clip(effort, self._least, self._most)
        memory["qfrc_applied"][:] = own["effort_applied"][:] = effort
        memory["xfrc_applied"][:] = 0.0
        memory["ctrl"][:] = own["control"]
        memory["wind"][:] = own["wind"]

    def _push(self) -> None:
        """Apply forces and moments of bodies, for MuJoCo in world axes at the centre of mass."""
        data, wrench = self._data, self._own["wrench"]
        self._mujoco.mj_kinematics(self._model, data)
        for body in self._driven:
            force, moment = wrench[6 * body : 6 * body + 3].tolist(), wrench[6 * body + 3 : 6 * body + 6].tolist()
            lever = (data.xpos[body] - data.xipos[body]).tolist()
            acting, about = wrench_at_center(data.xmat[body].tolist(), lever, force, moment)
            data.xfrc_applied[body] = (*acting, *about)

    def _look_at_warnings(self) -> None:
        """Fail if the world cannot be computed any more, naming an input or a joint; log all other warnings."""
        texts = [" ".join(text.split()) for text in warnings]
        warnings.clear()
        kinds = self._mujoco.mjtWarning
        bad = (kinds.mjWARN_BADQPOS, kinds.mjWARN_BADQVEL, kinds.mjWARN_BADQACC, kinds.mjWARN_BADCTRL)
        if any(self._data.warning[int(kind)].number for kind in bad):
            hint = "Are the inputs of this instance right? Otherwise a smaller step or more `physics_steps` may help."
            raise StepFailed(f"MuJoCo says: {' '.join(texts)}", instance=self.name, variable=self._culprit(), hint=hint)
        for text in texts:
            self._warn(text)

    def _warn(self, text: str) -> None:
        self._log(LogMessage(self.name, "warning", "engine", text, self._step))

    def _culprit(self) -> str | None:
        """The first input that is not finite, or else the first joint with a huge acceleration."""
        for name, entry in self._entries.items():
            if entry.where in _INPUTS and not math.isfinite(self._arrays[entry.where][entry.index]):
                return name
        accelerations = self._data.qacc
        for name, entry in self._entries.items():
            if entry.where == "acceleration" and not abs(accelerations[entry.index]) < self._mujoco.mjMAXVAL:
                return name
        return None

    # --- what is read

    def _refresh(self, *, sensors: bool, bodies: Mapping[int, bool]) -> None:
        """Compute what follows from positions and velocities for this point: after `mj_step` it is one step old.

        ``bodies`` is what `_bodies_of` returns.
        """
        mujoco, model, data, own = self._mujoco, self._model, self._data, self._own
        if sensors:  # those of accelerations and forces keep what the last step found
            mujoco.mj_step1(model, data)
        else:
            mujoco.mj_kinematics(model, data)
            mujoco.mj_comPos(model, data)
            mujoco.mj_comVel(model, data)
        wind = own["wind"].tolist()
        result = np.zeros(6)
        for body, wholly in bodies.items():
            place = slice(3 * body, 3 * body + 3)
            mujoco.mj_objectVelocity(model, data, mujoco.mjtObj.mjOBJ_XBODY, body, result, 0)
            rotation, velocity = data.xmat[body].tolist(), result[3:].tolist()
            own["angular_velocity"][place] = result[:3]
            own["linear_velocity"][place] = velocity
            own["body_wind"][place] = to_body(rotation, wind)
            own["relative_velocity"][place] = relative_velocity(rotation, velocity, wind)
            if wholly:
                own["body_linear_velocity"][place] = to_body(rotation, velocity)
                own["body_angular_velocity"][place] = to_body(rotation, result[:3].tolist())
                own["state"][STATE * body :][:STATE] = (*data.xpos[body], *data.xquat[body], *velocity, *result[:3])

    def _finish(self, step: int) -> None:
        """Compute the outputs of this point, write them as row ``step``, and show the world."""
        if self._reads or self._picture is not None:
            self._refresh(sensors=self._reads_sensors, bodies=self._reads_bodies)
        for ring, groups in self._outputs:
            row = ring.part("Float64")[step & ring.mask]
            for where, places, columns in groups:
                row[columns] = self._arrays[where][places]
        if self._picture is not None:
            self._picture.show(self._model, self._data, self._start_time + step * self._points * self._base)
            if step == self._last_step:
                self._picture.finish()

    def _remembered(self) -> list[Floats]:
        """The parts of a state that `mj_getState` does not have: inputs, and results of the last step."""
        own = (self._own[name] for name in ("acceleration", "effort_applied", *sorted(_INPUTS)))
        return [*own, self._data.sensordata, self._data.actuator_force]


def _grouped(entries: Sequence[WorldVariable]) -> list[tuple[str, NDArray[np.intp], NDArray[np.intp]]]:
    """(kind, indices in its array, columns) of all variables, so that one assignment copies all of a kind."""
    groups: dict[str, tuple[list[int], list[int]]] = {}
    flat = [(entry.where, entry.index + element) for entry in entries for element in range(entry.variable.size)]
    for column, (where, index) in enumerate(flat):
        places, columns = groups.setdefault(where, ([], []))
        places.append(index)
        columns.append(column)
    return [(where, np.array(places), np.array(columns)) for where, (places, columns) in groups.items()]


def _bodies_of(entries: Iterable[WorldVariable]) -> dict[int, bool]:
    """The bodies whose velocities have to be computed for these variables; True where a seldom one is among them."""
    found: dict[int, bool] = {}
    for entry in entries:
        if entry.where in _OF_VELOCITIES | _SELDOM:
            body = entry.index // (STATE if entry.where == "state" else 3)
            found[body] = found.get(body, False) or entry.where in _SELDOM
    return found
