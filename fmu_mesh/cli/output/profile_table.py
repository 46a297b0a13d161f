"""`--profile`: where the time of a run went, as a table and as a trace file for Chrome and Perfetto.

Owns how a `MeshProfile` is shown. A trace file is JSON in the Trace Event Format: one process per node, with
its bursts of steps and its waits; the summary is in it as `otherData.fmu_mesh`.
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import msgspec

from ...files import write_whole
from ...pictures.tables import table
from ...printing import page
from ...system.plan import RECORDER, Plan
from ...wire.time_profile import GRANT, MeshProfile, NodeProfile

__all__ = ["critical_path", "profile_page", "show_profile", "summary_of", "trace"]

_HOLDERS = {RECORDER: "the recorder", "@clock": "the wall clock", "@pause": "a pause"}
_LITTLE = 0.1
"""Shares of the time below this one are ignored."""


def show_profile(plan: Plan, profile: MeshProfile, seconds: float, file: Path | None) -> None:
    """Print the table of a run that took ``seconds``, and write the trace file if there is one."""
    print(page(profile_page(plan, profile)))
    if file is None:
        return
    write_whole(file, msgspec.json.encode(trace(plan, profile, seconds)), "the trace file ", make_folder=True)
    print(f"trace: {file} (open it at ui.perfetto.dev or chrome://tracing)")


def profile_page(plan: Plan, profile: MeshProfile) -> list[str]:
    """The table and the critical path as lines of text; shares are of the node's own time."""
    heading = ["node", "instance", "steps", "steps/s", "time", "compute", "transport", "wait", "other", "waits for"]
    rows = [row for node in profile.nodes for row in _rows(node)]
    lines = ["Profile", *table(rows, heading=heading, indent=2)]
    if cut := sum(node.cut for node in profile.nodes):
        lines.append(f"  The time lines leave out the last {cut} bursts and waits; the table holds all.")
    if path := critical_path(plan, profile):
        lines += ["Critical path", *(f"  {line}" for line in path)]
    return lines


def _rows(node: NodeProfile) -> Iterator[list[str]]:
    seconds = max(node.seconds, 1e-9)

    def share(part_s: float) -> str:
        return _share(part_s, seconds)

    reasons = sorted(node.wait_s.items(), key=lambda item: -item[1])
    waits = ", ".join(f"{reason or 'the grant'} {share(part_s)}" for reason, part_s in reasons if part_s)
    of_node = [share(node.transport_s), share(node.waited_s), share(_other_s(node)), waits]
    for number, unit in enumerate(node.units):
        own = [", ".join(unit.instances), str(unit.steps), f"{unit.steps / seconds:.0f}"]
        name, time, others = ("", "", [""] * len(of_node)) if number else (node.node, f"{node.seconds:.3f} s", of_node)
        yield [name, *own, time, share(unit.compute_s), *others]


def _share(part_s: float, seconds: float) -> str:
    return f"{100.0 * part_s / seconds:.0f} %"


def _other_s(node: NodeProfile) -> float:
    return max(0.0, node.seconds - node.compute_s - node.transport_s - node.waited_s)


def critical_path(plan: Plan, profile: MeshProfile) -> list[str]:
    """Which node waits for which, from the one that waits most to the one that sets the pace, in words."""
    nodes = {node.node: node for node in profile.nodes if node.seconds > 0.0}
    if not nodes:
        return []
    name: str | None = max(nodes, key=lambda own: _waiting(nodes[own]))
    lines: list[str] = []
    seen: list[str] = []
    while name is not None:
        node = nodes[name]
        if name in seen:
            together = [nodes[own] for own in seen[seen.index(name) :]]
            if any(_main_reason(own)[0] == GRANT for own in together):
                busiest = max(together, key=lambda own: (own.compute_s + own.transport_s) / own.seconds)
                window = f"the window of {plan.window} points holds them together"
                lines.append(f"{window}; the busiest of them is '{busiest.node}': {_work(busiest)}")
            else:
                names = " and ".join(f"'{own.node}'" for own in together)
                lines.append(f"{names} wait for each other: the messages between them set the pace")
            break
        seen.append(name)
        reason, part_s = _main_reason(node)
        if _waiting(node) < _LITTLE or (len(seen) > 1 and part_s < node.compute_s + node.transport_s):
            lines.append(f"'{name}' sets the pace: {_work(node)}")
            break
        following = plan.node_of(reason) if reason != GRANT else _holder(profile)
        lines.append(f"'{name}' waits {_share(part_s, node.seconds)} for {_awaited(name, reason, following)}")
        name = following if following in nodes and (reason != GRANT or following != name) else None
    return lines


def _main_reason(node: NodeProfile) -> tuple[str, float]:
    return max(node.wait_s.items(), key=lambda item: item[1], default=(GRANT, 0.0))


def _awaited(name: str, reason: str, following: str | None) -> str:
    if reason != GRANT:
        return f"'{reason}'" if reason == following else f"'{reason}' in '{following}'"
    if following is None:
        return "the grant"
    if following == name:
        return "the grant, which its own progress holds back: the way to the master and back sets the pace"
    return f"the grant, which {_HOLDERS.get(following, repr(following))} holds back"


def _waiting(node: NodeProfile) -> float:
    return node.waited_s / node.seconds


def _holder(profile: MeshProfile) -> str | None:
    """The instance, or other cause, that held the grant back for the longest time."""
    return max(profile.held_s, key=lambda holder: profile.held_s[holder], default=None)


def _work(node: NodeProfile) -> str:
    return f"{_share(node.compute_s, node.seconds)} compute, {_share(node.transport_s, node.seconds)} transport"


def summary_of(plan: Plan, profile: MeshProfile, seconds: float) -> dict[str, Any]:
    """The figures of the table as JSON: times in s."""
    points = plan.grid.last_point - plan.grid.first_point
    rate = points / seconds if seconds > 0.0 else 0.0
    return {
        "mesh": plan.system.config.mesh,
        "points": points,
        "seconds": seconds,
        "points_per_second": rate,
        "real_time_factor": rate * plan.grid.step_size,
        "nodes": [
            {
                "node": node.node,
                "host": node.host,
                "pid": node.pid,
                "seconds": node.seconds,
                "compute_s": node.compute_s,
                "transport_s": node.transport_s,
                "wait_s": {reason or "grant": part_s for reason, part_s in node.wait_s.items()},
                "other_s": _other_s(node),
                "units": [
                    {**msgspec.to_builtins(unit), "steps_per_second": unit.steps / max(node.seconds, 1e-9)}
                    for unit in node.units
                ],
                "cut": node.cut,
            }
            for node in profile.nodes
        ],
        "grant_held_s": profile.held_s,
        "critical_path": critical_path(plan, profile),
    }


def trace(plan: Plan, profile: MeshProfile, seconds: float) -> dict[str, Any]:
    """The time lines as a document in the Trace Event Format; its times are in microseconds.

    Nodes of one host share a clock. The time lines of another host begin at its own first point.
    """
    origins: dict[str, float] = {}
    for node in profile.nodes:
        origins[node.host] = min(origins.get(node.host, node.started), node.started)
    events: list[dict[str, Any]] = []
    for number, node in enumerate(profile.nodes, 1):
        events += _named(number, node)
        events += _slices(number, node, origins[node.host])
    return {
        "traceEvents": events,
        "displayTimeUnit": "ms",
        "otherData": {"fmu_mesh": summary_of(plan, profile, seconds)},
    }


def _named(number: int, node: NodeProfile) -> list[dict[str, Any]]:
    """The names of a node in the viewer. Process ids of two hosts can be equal, so nodes are numbered."""
    text = f"{node.node} (process {node.pid} on {node.host})"
    return [
        {"ph": "M", "name": "process_name", "pid": number, "tid": 1, "args": {"name": text}},
        {"ph": "M", "name": "process_sort_index", "pid": number, "tid": 1, "args": {"sort_index": number}},
        {"ph": "M", "name": "thread_name", "pid": number, "tid": 1, "args": {"name": "steps and waits"}},
    ]


def _slices(number: int, node: NodeProfile, origin: float) -> list[dict[str, Any]]:
    def slice_(name: str, category: str, start: float, end: float) -> dict[str, Any]:
        return {
            "ph": "X",
            "name": name,
            "cat": category,
            "ts": round((start - origin) * 1e6, 3),
            "dur": round(max(0.0, end - start) * 1e6, 3),
            "pid": number,
            "tid": 1,
        }

    found = []
    for burst in node.bursts:
        name = ", ".join(node.units[burst.unit].instances)
        found.append({**slice_(name, "compute", burst.start, burst.end), "args": {"steps": burst.steps}})
    found += [slice_(f"wait for {w.reason or 'the grant'}", "wait", w.start, w.end) for w in node.waits]
    return sorted(found, key=lambda event: float(event["ts"]))
