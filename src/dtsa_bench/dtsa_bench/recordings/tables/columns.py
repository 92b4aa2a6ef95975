"""What each column of each table holds: the one place from which the documents and the files' metadata come.

python -m dtsa_bench.recordings.tables.columns > docs/reference/columns.md
"""

from __future__ import annotations

from dtsa_agent.core.registry import REASON_TEXTS

AXES = "xyz"
_PAIR = "whether the pair counts in the results: the observer still has the agent in A_p, and the agent moves"

# Columns by table: name, unit, meaning.
COLUMNS: dict[str, list[tuple[str, str, str]]] = {
    "slots": [
        ("slot", "1", "number of the slot, from 0"),
        ("time_s", "s", "start of the slot, counted from the start of slot 0"),
        ("outcome", "", "the channel's verdict: idle, success, collision (merged: two or more sent); empty: not known"),
        ("senders", "1", "agents that sent; empty: not known"),
        ("sender", "", "id of the first of them; 0: nobody; empty: not known"),
    ],
    "frames": [
        ("slot", "1", "slot in which the frame was sent"),
        ("time_s", "s", "start of that slot"),
        ("sender", "", "id of the agent that sent it"),
        ("received", "1", "agents that received it"),
        ("lost", "1", "agents that lost it to noise (merged: that did not receive it, for whatever reason)"),
        ("collided", "1", "agents at which it collided with another frame; empty: not known"),
        ("length", "byte", "length of the frame"),
        ("data", "", "the frame, hexadecimal"),
        ("c_r", "1", "transmission parameter in the frame; 0: arrived; empty if the frame cannot be decoded"),
        *((f"position_{axis}_m", "m", f"position {axis} in the frame, frame map") for axis in AXES),
        *((f"velocity_{axis}_mps", "m/s", f"velocity {axis} in the frame, frame map") for axis in AXES),
    ],
    "receptions": [
        ("slot", "1", "slot in which the frame was sent"),
        ("time_s", "s", "start of that slot"),
        ("sender", "", "id of the agent that sent it"),
        ("receiver", "", "id of another agent"),
        ("received", "", "whether that one received it; empty: not known"),
    ],
    "decisions": [
        ("slot", "1", "slot that was decided about"),
        ("time_s", "s", "start of that slot"),
        ("agent", "", "id of the agent that decided"),
        ("chosen", "", "id of the agent that it takes for the sender; 0: nobody"),
        ("reason", "", "why, by name; see below"),
        ("score", "1", "priority value g of the chosen agent, 0 where the policy has none"),
        ("digest", "", "digest of the agent's table: equal digests, equal tables"),
    ],
    "states": [
        ("time_s", "s", "time of the state, counted from the start of slot 0"),
        ("agent", "", "id"),
        *((f"position_{axis}_m", "m", f"true position {axis}, frame map") for axis in AXES),
        *((f"velocity_{axis}_mps", "m/s", f"true velocity {axis}, frame map") for axis in AXES),
    ],
    "ages": [
        ("slot", "1", "the slot at whose end this holds; the results count from slot N - 1 on"),
        ("time_s", "s", "end of that slot"),
        ("agent", "", "id of the agent that is known"),
        ("observers", "1", "how many others have it in A_p and have heard it; 0 for agents that hover"),
        ("age_slots", "slots", "mean age of what they know: 0 if heard in this very slot; empty without observers"),
        ("error_m", "m", "mean distance between where they take it to be and where it is; empty without observers"),
    ],
    "ages_by_observer": [
        ("slot", "1", "the slot at whose end this holds; the results count from slot N - 1 on"),
        ("time_s", "s", "end of that slot"),
        ("observer", "", "id of the agent that knows"),
        ("agent", "", "id of the agent that is known; rows begin when the observer first hears it"),
        ("age_slots", "slots", "slots since the state was sent that the observer last heard; 0: in this very slot"),
        ("error_m", "m", "distance between where the observer takes the agent to be and where it is; empty: not known"),
        ("counted", "", _PAIR),
    ],
}  # fmt: skip


_HEAD = """\
# Columns of the tables

Of `tools/dtsa export` and of the data frames of `import dtsa`. Ids begin at 1. Times are simulated and count
from the start of slot 0. Frame `map` has its origin in the room's centre (ENU: x and y level, z up).

Of a bag that `tools/dtsa merge` has made, slot 0 is the first slot that all agents counted alike; the number that the
agents gave it is in the bag. Values that no agent's bag holds are empty there, or have no row: decisions, states and
observers of an agent without a bag, what it sent in slots in which nobody heard it, and whether it received.
"""


def describe() -> str:
    """The columns of all tables as Markdown."""
    parts = [_HEAD]
    for table, columns in COLUMNS.items():
        parts.append(f"\n## {table}\n\n| column | unit | meaning |\n|---|---|---|\n")
        parts.extend(f"| `{name}` | {unit} | {meaning} |\n" for name, unit, meaning in columns)
    parts.append("\n## Reasons\n\n| reason | meaning |\n|---|---|\n")
    parts.extend(f"| `{name}` | {text} |\n" for name, text in REASON_TEXTS.items())
    return "".join(parts)


if __name__ == "__main__":
    print(describe(), end="")
