"""How long the processes of a run wait for one another where `timeouts` of the configuration does not say it."""

from __future__ import annotations

import msgspec

__all__ = ["Deadlines"]


class Deadlines(msgspec.Struct, frozen=True, kw_only=True):
    """Each in s; all are measured by a clock that stands still while its own process cannot run (`AwakeClock`)."""

    # --- the launcher, while the run goes on

    # How often it looks whether a process is stopped or has ended, where nothing else happens.
    look: float = 0.25
    # A lost node: the master notices it within milliseconds and reports it. If it does not, this process does.
    report: float = 1.5
    # A node that ended because of its FMU has told the master, which may wait for the recorder before it ends.
    report_of_failure: float = 8.0
    # The master sends an event ten times per second. Without one for so long after the deadline of a step, it counts
    # as lost: its nodes have ended before, and said why.
    silence: float = 10.0
    # A gateway ends with its mesh. If it has ended so long before the mesh, it has lost its link.
    gateway: float = 2.0
    # From an interrupt until the launcher no longer waits for an orderly end.
    interrupt: float = 0.9

    # --- the launcher, at the end

    # Between two looks: an end is noticed by its event, and only that of a process which leaves others behind is late.
    look_at_end: float = 0.05
    # For processes to end by themselves after the outcome, or after SIGTERM.
    leave: float = 0.7
    # The same without an outcome: most of them wait for somebody who is gone.
    leave_lost: float = 0.1
    # After SIGTERM, where a person waits for the end.
    leave_interrupted: float = 0.3
