"""A station: one agent with a clock of its own. Datagrams and time in, datagrams and the time of the next wake-up out.

It knows no clock and no I/O. The rules: ``libdtsa/station``, and in plain Python ``core/reference/station``. Times are
ns of the own clock.
"""

from __future__ import annotations

import re
from collections.abc import Callable
from dataclasses import dataclass
from enum import IntEnum
from typing import Any, NamedTuple, Protocol

from .authentication import Authenticator
from .errors import ConfigError
from .frame import TAG_LENGTH, position_step
from .kernel import ffi, fields_of, lib
from .registry import POLICIES
from .settings.config import SwarmConfig
from .swarm import Presence, Swarm

#: What became of a datagram, in the order of ``dtsa_verdict``; empty: it was accepted.
VERDICTS = (
    "", "not ours", "length", "other settings", "no frame", "unknown agent", "rejected", "repeated", "other time",
    "own id", "too early",
)  # fmt: skip
_, _, LENGTH, OTHER_SETTINGS, NO_FRAME, _, REJECTED, REPEATED, OTHER_TIME, _, TOO_EARLY = VERDICTS
STATES = ("listening", "alone", "joined")
ALL_BUT_ONE = "all-but-one"
QUORUMS = f"{ALL_BUT_ONE}, a share of the others (80%), or a number of them (0: it never hovers for this)"
_SECOND = 1_000_000_000
BETWEEN = lib.DTSA_BETWEEN / 1000  # of a slot, between a frame that left late and the next slot
EARLY_COUNT = 64  # frames of slots still to come that are kept


@dataclass(frozen=True, slots=True)
class ClockMap:
    """An agent's clock: CLOCK_MONOTONIC, in trials with an offset and a drift."""

    offset_ns: int = 0  # by how much it is ahead at `began_ns`
    drift_ppb: int = 0  # parts per billion by which it runs fast
    began_ns: int = 0  # CLOCK_MONOTONIC

    def local_ns(self, monotonic_ns: int) -> int:
        """What the clock shows at a time of CLOCK_MONOTONIC."""
        return monotonic_ns + self.offset_ns + (monotonic_ns - self.began_ns) * self.drift_ppb // _SECOND

    def monotonic_ns(self, local_ns: int) -> int:
        """The first ns of CLOCK_MONOTONIC at which the clock shows a time, or is past it."""
        elapsed = local_ns - self.offset_ns - self.began_ns
        return self.began_ns + elapsed - elapsed * self.drift_ppb // (_SECOND + self.drift_ppb)


class HoverReason(IntEnum):
    """Why an agent hovers, as in ``dtsa_station.h``."""

    NONE = 0  # it flies
    LISTENS = 1  # it has no slots yet
    IS_NEW = 2  # the others may not know it yet
    SAME_ID = 3  # another agent sends as this one
    NO_QUORUM = 4  # too few of the others hear it, or are heard


class KeepsTime(IntEnum):
    """What stays as it is, whatever an agent hears."""

    NOTHING = 0  # slots move as the rules say
    NUMBERS = 1  # of slots, which move with frames that fit
    STARTS = 2  # of slots, and their numbers


@dataclass(frozen=True, slots=True)
class Link:
    """What carries the datagrams of a swarm."""

    header: bytes  # with which all of them begin
    says_late: bool  # they say how late they left
    names: int  # heard agents that each names
    flight_ns: int  # from the order to send one until it arrives
    trust_ns: int  # frames that are off by more do not show where slots begin


class Named(NamedTuple):
    """An agent that a datagram names: one that its sender hears."""

    id: int
    late_ns: int  # how much later than expected


class ParsedDatagram(NamedTuple):
    """What a datagram says; ``fault`` why it says nothing, or an empty text."""

    fault: str
    sender: int = 0
    slot: int = 0
    late_ns: int = 0
    names: tuple[Named, ...] = ()
    frame: bytes = b""  # without its tag


class Events(Protocol):
    """Recorder of what happens to a station."""

    def opened(self, slot: int, start_ns: int, is_first: bool) -> None:
        """A slot is open: the agent has decided."""

    def restarted(self, slot: int) -> None:
        """A slot is over, and the agent restarts with the next."""

    def heard(self, sender: int, slot: int, datagram: bytes, arrival_ns: int, accepted: bool) -> None:
        """The slot of a frame has begun, and the agent has heard it."""

    def refused(self, fault: str, datagram: bytes, arrival_ns: int) -> None:
        """A datagram was not accepted."""


def check_slotted(policy: str) -> None:
    """Raise a ConfigError for a policy whose frames may begin at any instant: only `simulate`, `sweep` carry those."""
    if POLICIES.row(policy).unslotted:
        raise ConfigError("policy", policy, "a policy with slots; those without fly in simulate and sweep only")


def check_joinable(policy: str) -> None:
    """Raise a ConfigError for a policy with which agents cannot come into a flight that is under way."""
    row = POLICIES.row(policy)
    if not row.may_join or row.unslotted:
        joinable = [row.name for row in POLICIES.rows.values() if row.may_join]
        raise ConfigError("policy", policy, f"{', '.join(joinable)}, to come into a flight that is under way")


def longest_wait_ns(config: SwarmConfig) -> int:
    """How long after the start of its own slot an agent may wait for the frame of the one before, ns."""
    return 0 if config.policy_row.may_join else min(config.slot_ns * lib.DTSA_MAX_WAIT // 1000, lib.DTSA_MAX_WAIT_NS)


def parse_quorum(text: object) -> tuple[int, float]:
    """Number and share that a quorum's text means, for ``dtsa_station_settings``; ConfigError: none."""
    match = re.fullmatch(r"([0-9]+)|([0-9]+(?:\.[0-9]+)?)%", text) if isinstance(text, str) else None
    if text == ALL_BUT_ONE:
        return lib.DTSA_QUORUM_ALL_BUT_ONE, 0.0
    if match and match[1]:
        return int(match[1]), 0.0
    if match and float(match[2]) <= 100.0:
        return lib.DTSA_QUORUM_SHARE, float(match[2]) / 100.0
    raise ConfigError("quorum", text, QUORUMS)


class StationSettings:
    """The settings of a station as C has them; they also read and write datagrams.

    :param config: the settings that all agents share.
    :param link: what carries the datagrams.
    :param authenticator: key and session, if frames are signed.
    :param id: own id; 1 where only datagrams are read.
    :param origin_ns: when slot 0 starts, by the own clock; None: that is not known.
    :param listens: it listens first, and goes by ``origin_ns`` only if it hears no frame.
    :param keeps_time: whether slots move with what is heard.
    :raises ConfigError: for a quorum that cannot be.
    """

    def __init__(
        self, config: SwarmConfig, link: Link, authenticator: Authenticator | None = None, id: int = 1,
        quorum: str = "0", origin_ns: int | None = None, listens: bool = False,
        keeps_time: KeepsTime = KeepsTime.NOTHING,
    ) -> None:  # fmt: skip
        key, session = (b"", 0) if authenticator is None else authenticator.key_and_session
        row, (number, share) = config.policy_row, parse_quorum(quorum)
        if number >= config.agents:
            raise ConfigError("quorum", quorum, f"at most {config.agents - 1}, the number of the others")
        sends = lib.DTSA_SENDS_BY_CHANCE if "received" in row.port else lib.DTSA_SENDS_IN_TURNS
        begins = lib.DTSA_BEGINS_LATE if listens else lib.DTSA_BEGINS_TOGETHER
        self._key = ffi.new("uint8_t[]", key)
        lease = {"anchor_every": config.anchor_every, "main_every": config.main_every, "open_every": config.open_period}
        cycle = lib.dtsa_slot_cycle(ffi.new("dtsa_config *", {"agents": config.agents, "lease": lease}))
        self.c = ffi.new("dtsa_station_settings *", {
            "id": id, "agents": config.agents, "anchor_every": config.turn_every,
            # Agents that rest send in main anchors alone.
            "main_every": config.main_every if row.probation else config.turn_every, "slot_cycle": cycle,
            "extended": config.extended, "own_bytes": config.own_bytes,
            "frame_length": config.frame_length - (TAG_LENGTH if config.auth else 0),
            "position_step": position_step(config.extent_m), "slot_ns": config.slot_ns, "seed": config.seed,
            "sends": lib.DTSA_SENDS_IN_ANCHORS if row.extended else sends,
            "quorum": number, "quorum_share": share,
            "key": self._key if key else ffi.NULL, "key_length": len(key), "session": session,
            "early_count": EARLY_COUNT, "origin_ns": origin_ns or 0,
            "begins": lib.DTSA_BEGINS_LISTENING if origin_ns is None else begins,
            "keeps_time": keeps_time, "equal_tables": not row.may_join,
            "link": fields_of("dtsa_link", link, header_length=len(link.header)),
        })  # fmt: skip
        self.names = link.names
        self.length: int = lib.dtsa_datagram_length(self.c)  # of all datagrams, bytes
        self.too_long_ns: int = lib.dtsa_station_too_long(self.c)  # a stand-still after which an agent restarts

    def read(self, data: bytes) -> ParsedDatagram:
        """What a datagram says."""
        out = ffi.new("dtsa_datagram *")
        verdict = lib.dtsa_datagram_read(self.c, data, len(data), out)
        if verdict:
            return ParsedDatagram(VERDICTS[verdict])
        names = tuple(Named(entry.id, entry.late_ns) for entry in list(out.names)[: self.names] if entry.id)
        frame = bytes(ffi.buffer(out.frame, out.frame_length))
        return ParsedDatagram("", out.sender, out.slot, out.late_ns, names, frame)

    def hears(self, names: tuple[Named, ...], agent: int) -> bool | None:
        """Whether the sender of a datagram with these names hears an agent; None: it does not say."""
        answer: int = lib.dtsa_names_hear(ffi.new("dtsa_named[]", list(names)), len(names), self.names, agent)
        return answer > 0 if answer else None

    def write(self, frame: bytes, slot: int, late_ns: int = 0, names: tuple[tuple[int, int], ...] = ()) -> bytes:
        """The datagram of a frame that carries no tag yet.

        :param late_ns: how much later than its slot it leaves.
        :param names: ids of heard agents, and how much later than expected each is heard, ns.
        """
        if len(frame) != self.c.frame_length:
            raise ValueError(f"frame: got {len(frame)} bytes; allowed: {self.c.frame_length}")
        out = ffi.new("uint8_t[]", lib.DTSA_DATAGRAM_MAX)
        named = ffi.new("dtsa_named[]", [*names, *((0, 0),) * (lib.DTSA_NAMES_MAX - len(names))])
        length = lib.dtsa_datagram_write(self.c, frame, slot % self.c.slot_cycle, late_ns, named, out)
        return bytes(ffi.buffer(out, length))


class Station:
    """One agent of a swarm, from its first frame to its last.

    :param swarm: the agent, alone in its :class:`Swarm`.
    :param settings: see there.
    :param now_ns: when it begins to listen.
    :param before_slot: is called before the agent decides for a slot; writes its state.
    :param events: is told what happens.
    :param every_frame: also of each slot and each frame that is heard.
    """

    def __init__(
        self, swarm: Swarm, settings: StationSettings, now_ns: int, before_slot: Callable[[int], None] | None = None,
        events: Events | None = None, every_frame: bool = True,
    ) -> None:  # fmt: skip
        self.swarm, self._settings, self._before, self.events = swarm, settings, before_slot, events
        self.fault: BaseException | None = None  # raised in a callback; the caller of C raises it again
        self._moves = bool(swarm.scenario.moving[swarm.local[0]])
        self._handle = ffi.new_handle(self)
        size = lib.dtsa_station_bytes(settings.c)
        self._memory = ffi.new("double[]", size // 8 + 1)
        self.c = lib.dtsa_station_start(self._memory, size, settings.c, self._agent(), now_ns)
        if not self.c:
            raise ValueError("a station cannot be made of these settings")
        if events is not None:
            lib.dtsa_station_observe(self.c, self._observer(every_frame))
        self._out = ffi.new("uint8_t[]", lib.DTSA_DATAGRAM_MAX)
        self._buffer, self._length = ffi.buffer(self._out), ffi.new("int *")
        self._status = ffi.new("dtsa_station_status *")
        self._receive, self._step = lib.dtsa_station_receive, lib.dtsa_station_step

    def _agent(self) -> Any:
        swarm = self.swarm
        if not swarm.all_in_c or swarm.authenticator is not None:
            return ffi.new("dtsa_station_agent *", [
                self._handle, lib.station_open, lib.station_hear, lib.station_unsent, lib.station_close,
                lib.station_restart, lib.station_leave, lib.station_on_probation,
            ])  # fmt: skip
        is_prepared = self._before is not None or swarm.course is not None
        prepare = lib.station_prepare if is_prepared else ffi.NULL
        self._pilot = ffi.new("swarm_pilot *", [swarm.kernel, self._moves, self._handle, prepare])
        return ffi.new("dtsa_station_agent *", lib.swarm_station_agent(self._pilot))

    def _observer(self, every_frame: bool) -> Any:
        opened, heard = (lib.station_opened, lib.station_heard) if every_frame else (ffi.NULL, ffi.NULL)
        return ffi.new("dtsa_station_events *", [
            self._handle, opened, lib.station_restarted, ffi.NULL, heard, lib.station_refused,
        ])  # fmt: skip

    def receive(self, data: bytes, arrival_ns: int) -> int:
        """Hand in a datagram, whatever it is, in the order of arrival; returns an index into ``VERDICTS``."""
        verdict: int = self._receive(self.c, data, len(data), arrival_ns)
        self.raise_fault()
        return verdict

    def step(self, now_ns: int) -> tuple[int, bytes]:
        """Do one thing that is due. Returns when to call again (not after now: at once), and what to send now."""
        due: int = self._step(self.c, now_ns, self._out, self._length)
        self.raise_fault()
        length = self._length[0]
        return due, self._buffer[:length] if length else b""

    def sent(self, now_ns: int, taken: bool) -> None:
        """Say what became of the datagram that the last step gave; False: the port has refused it."""
        lib.dtsa_station_sent(self.c, now_ns, taken)

    def leave(self) -> None:
        """Announce on the air that the agent leaves, where frames can."""
        lib.dtsa_station_leave(self.c)

    def awaits_frame(self, now_ns: int) -> bool:
        """Whether a datagram may make it due earlier; until then datagrams may wait in the port."""
        return bool(lib.dtsa_station_awaits_frame(self.c, now_ns))

    @property
    def slot(self) -> int:
        """The present slot, -1: none yet."""
        return int(lib.dtsa_station_slot(self.c))

    def slot_start_ns(self, slot: int) -> int:
        """When a slot starts; it may still move a little with what is heard."""
        return int(lib.dtsa_station_slot_start(self.c, slot))

    def longest_gap(self) -> tuple[int, int]:
        """The longest that it has waited for a frame of an agent that it had heard, slots, and that agent's id."""
        agent = ffi.new("int *")
        return int(lib.dtsa_station_longest_gap(self.c, agent)), agent[0]

    @property
    def status(self) -> Any:
        """A ``dtsa_station_status``, good until it is asked for again."""
        lib.dtsa_station_get_status(self.c, self._status)
        return self._status

    @property
    def hovers(self) -> int:
        """Why the agent hovers in the present slot; ``HoverReason.NONE``: it does not."""
        return int(lib.dtsa_station_hovers(self.c))

    def raise_fault(self) -> None:
        """Raise what a callback has raised."""
        if self.fault is not None:
            fault, self.fault = self.fault, None
            raise fault

    # What C calls.

    def prepare(self, slot: int, hovers: int) -> None:
        swarm = self.swarm
        if self._before is not None:
            self._before(slot)
        swarm.active[0] = self._moves
        swarm.scenario.advance(slot, swarm)
        if hovers:
            swarm.active[0] = 0

    def open(self, slot: int, hovers: int, frame: Any, chosen: Any) -> int:
        swarm = self.swarm
        self.prepare(slot, hovers)
        data = swarm.frame(0) if swarm.begin(slot) else b""
        chosen[0] = swarm.chosen[0]
        ffi.memmove(frame, data, len(data))
        return len(data)

    def leave_air(self) -> bool:
        self.swarm.leave(0)
        return bool(self.swarm.present[0] == Presence.LEAVING)

    def probation(self) -> bool:
        return self.swarm.config.policy_row.probation and bool(self.swarm.lease_status(0)["probation"])


def _callback(act: Callable[..., Any], name: str) -> None:
    """Let C call a function of (station, ...); an exception ends the call of the station's user."""
    is_void = ffi.typeof(getattr(lib, name)).result.cname == "void"

    def call(context: Any, *values: Any) -> int | None:
        station: Station = ffi.from_handle(context)
        try:
            answer = act(station, *values)
            return None if is_void else int(answer)
        except BaseException as error:
            station.fault = station.fault or error
            return None if is_void else 0

    ffi.def_extern(name)(call)


def _bytes(data: Any, length: int) -> bytes:
    return bytes(ffi.buffer(data, length))


_callback(Station.prepare, "station_prepare")
_callback(Station.open, "station_open")
_callback(lambda s, slot, data, n: s.swarm.hear(slot, _bytes(data, n)), "station_hear")
_callback(lambda s: s.swarm.drop(0), "station_unsent")
_callback(lambda s, slot: s.swarm.end(slot), "station_close")
_callback(lambda s: s.swarm.restart(0), "station_restart")
_callback(Station.leave_air, "station_leave")
_callback(Station.probation, "station_on_probation")
_callback(lambda s, slot, start, _, first: s.events.opened(slot, start, bool(first)), "station_opened")
_callback(lambda s, slot: s.events.restarted(slot), "station_restarted")
_callback(
    lambda s, sender, slot, data, n, arrival, ok: s.events.heard(sender, slot, _bytes(data, n), arrival, bool(ok)),
    "station_heard",
)
_callback(lambda s, verdict, data, n, at: s.events.refused(VERDICTS[verdict], _bytes(data, n), at), "station_refused")
