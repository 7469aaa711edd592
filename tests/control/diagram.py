"""Prints the arbiter's tables as a Mermaid state diagram and as Markdown tables, for docs/control.md."""

from __future__ import annotations

from itertools import groupby

from instant_ic.control.freshness import TimeoutConfig
from instant_ic.control.states import ACTIONS, GUARDS, SOURCES, TRANSITIONS, Mode


def state_diagram() -> str:
    """The state machine as a Mermaid diagram; neighbouring rows that differ in the guard alone are one arrow."""
    lines = ["stateDiagram-v2", "    [*] --> STOPPED"]
    for (source, target, action), rows in groupby(TRANSITIONS, lambda row: (row.source, row.target, row.action)):
        guards = ", ".join(row.guard for row in rows)
        lines.append(f"    {source.name} --> {target.name}: {guards} / {action}")
    return "\n".join(lines)


def guard_table() -> str:
    """The guards and actions of the diagram and their meaning, as a Markdown table."""
    rows = ["| Guard or action | Meaning |", "|---|---|"]
    rows += [f"| `{name}` | {meaning} |" for name, meaning in {**GUARDS, **ACTIONS}.items()]
    return "\n".join(rows)


def source_table(timeouts: TimeoutConfig | None = None) -> str:
    """Sources, the states that need them, and their time-outs, as a Markdown table."""
    timeouts = timeouts or TimeoutConfig()
    rows = [
        "| Source | Needed in | Command zero after | STOPPED after |",
        "|---|---|---|---|",
    ]
    for source in SOURCES:
        unused = set(Mode) - set(source.modes)
        modes = "all but STOPPED" if unused == {Mode.STOPPED} else ", ".join(mode.name for mode in source.modes)
        timeout = getattr(timeouts, source.key)
        zero = f"{timeout:g} s" + (", longer at low rates" if source.steady else "") if timeout else "never by default"
        stop = f"{max(timeout, timeouts.stop_after_s):g} s" if timeout else "never by default"
        rows.append(f"| {source.name} | {modes} | {zero} | {stop} |")
    return "\n".join(rows)
