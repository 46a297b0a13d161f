"""Whether a plan can run in one process: asked by all that run it so, and by what can start processes instead."""

from __future__ import annotations

import sys
from collections.abc import Mapping
from functools import partial
from pathlib import Path

from ..config.instance_sections import ProcessConfig
from ..errors import NotInOneProcess
from ..instances.registry import claims
from ..system.plan import Plan
from ..system.process_sharing import Claims, ClaimsOf, SharedProcess

__all__ = ["OneProcess", "apart", "claims_in", "is_other_python", "limited"]


class OneProcess:
    """A process that runs plans, one after another, and what it has loaded for them."""

    def __init__(self) -> None:
        self._process = SharedProcess()
        self._members: set[tuple[str, str]] = set()

    def check(self, plan: Plan, contents: Mapping[str, str]) -> None:
        """Refuse what cannot run in this process; groups do not matter here.

        Args:
            plan: the plan.
            contents: the SHA-256 of the model of each instance: what ran once can run again.

        Raises:
            NotInOneProcess: a component needs another Python, a node has limits of its own, or two instances cannot
                share a process.
        """
        hint = "Run the mesh in processes: leave out what keeps it in one, such as `processes=False`."
        for node in plan.nodes.values():
            if node.interpreter is not None and is_other_python(node.interpreter):
                text = f"'{node.node}' needs the Python '{node.interpreter}', and this process is another one"
                raise NotInOneProcess(text, hint=hint)
        for limit in limited(plan):
            raise NotInOneProcess(limit, hint=hint)
        claims_of = claims_in(plan)
        for name in plan.system.instances:
            member = name, contents.get(name, "")
            if member not in self._members:
                if (why := self._process.refusal(name, partial(claims_of, name))) is not None:
                    raise NotInOneProcess(why, hint=hint)
                self._members.add(member)


def is_other_python(interpreter: str) -> bool:
    """Whether ``interpreter`` is not the Python that runs this process, with the packages that it has.

    The Python of a virtual environment is a link in the folder of the environment.
    """
    own, other = Path(sys.executable), Path(interpreter)
    return (own.parent.resolve(), own.resolve()) != (other.parent.resolve(), other.resolve())


def apart(plan: Plan) -> list[str]:
    """Why a plan cannot run in one process: a sentence for each instance that another one keeps out."""
    process, claims_of = SharedProcess(), claims_in(plan)
    refusals = (process.refusal(name, partial(claims_of, name)) for name in plan.system.instances)
    return [*limited(plan), *(why for why in refusals if why is not None)]


def limited(plan: Plan) -> list[str]:
    """The instances of a plan that `process` gives limits or a sandbox, which only a process of their own has."""
    config = plan.system.config
    named = [name for name, own in config.instances.items() if config.process_of(own).of_node != ProcessConfig()]
    return [f"`process` limits '{name}', which needs a process of its own for that" for name in named]


def claims_in(plan: Plan) -> ClaimsOf:
    """What the instances of a plan claim of their process."""
    system = plan.system

    def claimed(name: str) -> Claims:
        own = system.instances[name]
        return claims(Path(own.fmu), system.config.instances[name], own.description, system.config.limits)

    return claimed
