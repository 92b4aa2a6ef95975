"""Records what one agent did and heard: MCAP with JSON messages, which needs no ROS.

What is in it: docs/reference/network.md.
"""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from time import monotonic_ns
from typing import TYPE_CHECKING, Any

from dtsa_agent.air.port import PortSettings
from dtsa_agent.air.record import Heard, SlotRecord
from dtsa_agent.air.settings import AgentSettings
from dtsa_agent.core import SwarmConfig
from dtsa_bench.runs.options import new_directory

from .json_bag import JsonBag, described

if TYPE_CHECKING:
    from dtsa_agent.air.driver import LiveAgent

SLOT, REFUSED = "slot", "refused"  # topics
METADATA, SUMMARY = "dtsa_agent", "dtsa_summary"  # metadata records
_AT_A_TIME = 8  # slots
_MOST_REFUSED = 50  # kept from one flush to the next: strangers cannot fill the disk


_HEARD = {
    "type": "array",
    "description": "frames of others heard in time, in this order",
    "items": described(
        "heard",
        sender=("integer", "id"),
        slot=("integer", "in which it was sent"),
        arrival_ns=("integer", "when it arrived, ns, own clock"),
        datagram=("string", "as it was on the air, hexadecimal"),
        accepted=("boolean", "whether the table took it"),
    ),
}
SLOT_SCHEMA = described(
    "dtsa.AgentSlot",
    slot=("integer", "number of the slot"),
    start_ns=("integer", "when it started, ns, own clock"),
    opened_ns=("integer", "when it was decided, ns, own clock"),
    anew=("boolean", "the agent began with this slot, or began anew, knowing nothing"),
    present=("integer", "1; 2: it is leaving"),
    chosen=("integer", "id taken for the sender; 0: nobody"),
    reason=("integer", "why: REASON_* of dtsa_msgs/Decision"),
    digest=("integer", "of the agent's table"),
    score=("number", "priority value g of the chosen, 0 where the policy has none"),
    track=("array", "m, frame map: true positions at the control instants of the slot before, (S, 3)"),
    velocity=("array", "m/s, at the slot's start"),
    command=("array", "m/s, commanded velocity then"),
    goal=("array", "m, where it flies to"),
    frame=("string", "what it was to send, without a tag, hexadecimal; empty: silent"),
    datagram=("string", "as on the air, hexadecimal; empty: nothing was sent"),
    sent_ns=("integer", "when that was handed to the port, ns, own clock; -1: not at all"),
)
SLOT_SCHEMA["properties"] |= {"before": _HEARD, "heard": _HEARD}
REFUSED_SCHEMA = described(
    "dtsa.AgentRefused",
    reason=("string", "why a datagram was not taken in"),
    data=("string", "the datagram, hexadecimal"),
    arrival_ns=("integer", "ns, own clock"),
)


def about_port(port: PortSettings) -> dict[str, str]:
    """What a bag says of the port: its settings under its name, and what they come to."""
    properties = dataclasses.asdict(port.properties)
    return {
        properties["name"]: json.dumps(port.to_dict(), sort_keys=True),
        "port": json.dumps(properties, sort_keys=True),
    }


class AgentRecorder(JsonBag):
    """The bag of one agent, written while it flies: a watcher of the agent.

    :param goals_told: the agent is told goals in flight, beside those of the scenario: none is known to be its last.
    :raises BagError: if the file cannot be made.
    """

    def __init__(
        self, path: Path, own: AgentSettings, config: SwarmConfig, port: PortSettings, goals_told: bool = False
    ) -> None:
        started = monotonic_ns() + own.clock_offset_ns  # own clock
        sections = {"own": own, "swarm": config}
        about = {name: json.dumps(section.to_dict(), sort_keys=True) for name, section in sections.items()}
        about |= {"id": str(own.id), "started_ns": str(started), **about_port(port)}
        about |= {"goals_told": "yes"} if goals_told else {}
        super().__init__(path, {SLOT: SLOT_SCHEMA, REFUSED: REFUSED_SCHEMA}, METADATA, about)
        self._refused = 0  # since the last flush
        self._slots: list[SlotRecord] = []  # not written yet
        self.left_out = 0  # refused datagrams of which no record is kept
        self.summary: dict[str, Any] = {}  # of the agent; known at the end

    def slot(self, record: SlotRecord) -> None:
        """A slot of the agent is over."""
        self._slots.append(record)  # several at a time: each then takes half as long
        if len(self._slots) >= _AT_A_TIME:
            self._write_slots()
            if self.flush_if_due():
                self._refused = 0

    def _write_slots(self) -> None:
        for record in self._slots:
            self._write_slot(record)
        self._slots.clear()

    def _write_slot(self, record: SlotRecord) -> None:
        self.write(SLOT, record.opened_ns, {
            "slot": record.slot, "start_ns": record.start_ns, "opened_ns": record.opened_ns, "anew": record.anew,
            "present": record.present, "chosen": record.chosen, "reason": record.reason, "digest": record.digest,
            "score": record.score, "track": record.track.tolist(), "velocity": record.velocity.tolist(),
            "command": record.command.tolist(), "goal": record.goal.tolist(), "frame": record.frame.hex(),
            "datagram": record.datagram.hex(),
            "sent_ns": record.sent_ns, "before": _heard(record.before), "heard": _heard(record.heard),
        })  # fmt: skip

    def other(self, reason: str, data: bytes, arrival_ns: int) -> None:
        """A datagram has not been taken in.

        :param data: its bytes.
        """
        self._refused += 1
        if self._refused > _MOST_REFUSED:
            self.left_out += 1
            return
        self.write(REFUSED, arrival_ns, {"reason": reason, "data": data.hex(), "arrival_ns": arrival_ns})

    def finish(self, summary: dict[str, Any]) -> None:
        """The flight is over.

        :param summary: the agent's own.
        """
        self.summary = summary
        self._write_slots()
        self.add_metadata(SUMMARY, {"summary": json.dumps(summary), "refused_left_out": str(self.left_out)})

    def __exit__(self, *unused: object) -> None:
        self._write_slots()
        super().__exit__(*unused)


@contextmanager
def recorded(out: str, agent: LiveAgent, port: PortSettings) -> Iterator[AgentRecorder]:
    """The directory of an agent that flies within the context: its bag, and at the end ``summary.json``.

    It is an entry point, so that the agent's node finds it (``dtsa.recorders``).

    :param out: the directory; it is empty or does not exist yet.
    :raises ConfigError: for a directory that cannot be used.
    :raises BagError: if the bag cannot be made.
    """
    directory = new_directory(out)
    with AgentRecorder(directory / f"cf{agent.own.id}.mcap", agent.own, agent.config, port) as recorder:
        agent.watcher = recorder
        yield recorder
        recorder.finish(agent.summary())
    (directory / "summary.json").write_text(json.dumps(recorder.summary, indent=2) + "\n", encoding="utf-8")


def _heard(frames: list[Heard]) -> list[dict[str, Any]]:
    return [
        {
            "sender": h.sender,
            "slot": h.slot,
            "arrival_ns": h.arrival_ns,
            "datagram": h.datagram.hex(),
            "accepted": h.accepted,
        }
        for h in frames
    ]  # fmt: skip
