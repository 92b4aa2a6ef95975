"""A station: one agent with a clock of its own. Datagrams and time in, datagrams and the time of the next wake-up out.

Every frame shows when its sender's slot 0 began: its *origin*. An agent has an origin of its own and moves it a little
towards those that it hears. A frame whose origin is off by more than the link is trusted with shows another time; see
:meth:`Station._yields_to` for whose time counts where two groups meet. An agent flies only while it hears, and is heard
by, a quorum of the others. All times are ns of the own clock; the same in C: ``libdtsa/station``.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

from .agent import Agent, Foreign, parse
from .arithmetic import mix64
from .datagram import (
    ACCEPTED,
    KEEPS_STARTS,
    OTHER_TIME,
    REPEATED,
    SAME_ID,
    SHARE,
    Parsed,
    Settings,
    names_hear,
    parse_datagram,
    write_datagram,
)  # fmt: skip
from .frame import Refused, condition_of
from .table import LEAVES, OFF, Rules

Ns = int  # ns, own clock

LISTENING, ALONE, JOINED = range(3)
FLIES, HOVERS_LISTENING, HOVERS_NEW, HOVERS_SAME_ID, HOVERS_QUORUM = range(5)
IN_STEP, SHIFTED, RESTARTED, OTHER = range(4)  # what a frame says of the time

HALF_SECOND_NS = 500_000_000
RECEPTIONS = 9  # offsets of frames that one alignment takes the median of
SENT_HISTORY_LENGTH = 16
CYCLES = 8  # of lists of one name each, after which an agent that was not named is not heard


@dataclass(slots=True)
class Peer:
    """What is known of another agent."""

    heard_ns: int | None = None  # arrival of its last frame
    origin_ns: int = 0  # ... and what that shows
    near_ns: int | None = None  # arrival of its last frame that fits the own slots
    last_slot: int = -1  # as on the air
    steady: bool = False  # its last two frames show the same time
    offset_ns: int | None = None  # how much later than expected it is heard
    report_ns: int | None = None  # how much later than expected it says to hear this agent
    reported_ns: int = 0  # when it said so last
    sum_ns: int | None = None
    unnamed: int = 0
    hears_us: int = 0  # 1: yes, -1: no, 0: it has not said
    resting: bool = False  # it sends in main anchors alone: it rests, or is on probation
    left: bool = False


class Counts(NamedTuple):
    """How the others stand with an agent."""

    others: int = 0
    hears: int = 0
    heard_by: int = 0
    both: int = 0
    needed: int = 0


def centred(a: int, b: int) -> int:
    """``a`` modulo ``b``, from -b/2 to b/2."""
    remainder = a % b
    return remainder - b if remainder > b // 2 else remainder


def limited(value: int, limit: int) -> int:
    return min(max(value, -limit), limit)


class Station:
    """See the module. ``agent`` gets its state before each step.

    :param rounds: an agent that rests sends at least so often, in rounds.
    """

    def __init__(self, settings: Settings, rules: Rules, agent: Agent, now: Ns, rounds: int) -> None:
        c, n, slot_ns = settings, rules.agents, settings.slot_ns
        self.settings, self.rules, self.agent = c, rules, agent
        anchors, mains = rules.anchor_every * n * slot_ns, rounds * n * slot_ns
        self.peers = [Peer() for _ in range(n)]
        self.cycle = rules.slot_cycle
        self.round_ns = anchors
        self.moving_ns, self.resting_ns = max(2 * anchors, HALF_SECOND_NS), max(6 * mains, HALF_SECOND_NS)
        self.patience_ns, self.too_long_ns = max(2 * mains, HALF_SECOND_NS), max(500 * slot_ns, 3 * anchors)
        self.lead_ns, self.latest_lead_ns = slot_ns * 700 // 1000, slot_ns * 200 // 1000
        if c.equal_tables:  # a late frame costs less than tables that differ
            self.latest_lead_ns, self.too_long_ns = -min(slot_ns * 300 // 1000, 3_000_000), (1 << 63) - 1
        self.latest_send_ns = max(slot_ns - c.link.flight_ns - slot_ns * 200 // 1000, slot_ns // 10)
        self.offsets: list[int] = []
        self.heard_ns = self.in_step_ns = now  # last frame of others, and of the own time; or the beginning
        self.earlier_since = 0
        self.earlier_ns: Ns | None = None
        self.flight_error_ns, self.name_turn = 0, 0
        self.same_id_until = now  # another agent has sent with the own id
        self.refused_since: Ns | None = None
        self.slot, self.first, self.origin_ns = -1, -1, 0
        self.running = self.awaits = self.newcomer = self.has_sent = self.leaving = self.gone = False
        self.hovers, self.frame, self.counts = HOVERS_LISTENING, b"", Counts()
        self.early: list[tuple[int, bytes]] = []
        self.sent_history: deque[bytes] = deque(maxlen=SENT_HISTORY_LENGTH)
        if c.begins_ns is not None:
            self.state, self.origin_ns, self.first = JOINED, c.begins_ns, 0
        else:  # spread over a round of anchors: one is the first, and the others hear it while they still listen
            self.state, self.deadline_ns = LISTENING, now + self.round_ns + self._draw(0) % self.round_ns

    def _draw(self, what: int) -> int:
        """A number that looks random, of 64 bits."""
        mixed = self.settings.seed * 0x9E3779B97F4A7C15 + self.settings.id * 0xD1B54A32D192ED03
        return mix64(mixed + what * 0x8CB92BA72F3D8DD7 - 0x9E3779B97F4A7C15)

    # When slots begin.

    def slot_start_ns(self, slot: int) -> Ns:
        return self.origin_ns + slot * self.settings.slot_ns

    def _slot_at(self, now: Ns) -> int:
        return (now - self.origin_ns) // self.settings.slot_ns

    def _apart(self, a_ns: Ns, b_ns: Ns | None = None) -> int:
        """How much later than another origin one is; without another: than the own."""
        return centred(a_ns - (self.origin_ns if b_ns is None else b_ns), self.cycle * self.settings.slot_ns)

    def _is_same(self, a_ns: Ns, b_ns: Ns | None = None) -> bool:
        return abs(self._apart(a_ns, b_ns)) <= self.settings.link.trust_ns

    def _is_near(self, origin_ns: Ns) -> bool:
        """Whether slots agree, if their numbers count from there."""
        return abs(self._apart(origin_ns)) < self.settings.slot_ns // 2

    def _align(self, offset_ns: int) -> int:
        """By how much the own slots move: half the median of some frames' offsets."""
        self.offsets.append(offset_ns)
        if len(self.offsets) < RECEPTIONS:
            return 0
        median = sorted(self.offsets)[RECEPTIONS // 2]
        self.offsets.clear()
        return (abs(median) + 1) // 2 * (1 if median >= 0 else -1)  # rounded away from zero: no direction is preferred

    def _yields_to(self, origin_ns: Ns, now: Ns) -> bool:
        """Whether the time that a frame shows is taken over.

        That is so when most of all agents heard lately are in it; when it is the earlier one and half of them are, or
        no frame was ever heard in the own one; or, after some patience, when no other agent is heard in the own one, or
        it is the earlier one and less than half of the swarm is in the own one.
        """
        recent = [p for p in self.peers if self._is_recent(p, p.heard_ns, now)]
        every = 1 + len(recent)
        here = 1 + sum(self._is_same(p.origin_ns) for p in recent)
        in_other_time = sum(p.steady and self._is_same(p.origin_ns, origin_ns) for p in recent)
        earlier = self._apart(origin_ns) < 0
        if 2 * in_other_time > every or (earlier and (self.state == ALONE or 2 * in_other_time == every)):
            return True
        if not in_other_time:
            return False
        if now - self.in_step_ns > self.patience_ns:
            return True
        if not earlier or 2 * here > self.rules.agents:
            return False
        if self.earlier_ns is None or now - self.earlier_ns > self.patience_ns:
            self.earlier_since = now
        self.earlier_ns = now
        return now - self.earlier_since > self.patience_ns

    def _adopt_time(self, origin_ns: Ns, now: Ns) -> None:
        self.offsets.clear()
        self.origin_ns, self.in_step_ns, self.earlier_ns, self.state = origin_ns, now, None, JOINED
        for p in self.peers:
            p.near_ns = p.heard_ns if self._is_near(p.origin_ns) else None

    def _hear_time(self, p: Peer, origin_ns: Ns, arrival: Ns) -> int:
        p.steady = p.heard_ns is not None and self._is_same(p.origin_ns, origin_ns)
        p.heard_ns, p.origin_ns = arrival, origin_ns
        if self.state == LISTENING:
            self._adopt_time(origin_ns, arrival)
            return RESTARTED
        apart, near = self._apart(origin_ns), self._is_near(origin_ns)
        if near:
            p.near_ns = arrival
        if self._is_same(origin_ns):
            if self.settings.keeps_time != KEEPS_STARTS:
                self.origin_ns += self._align(apart)
            self.in_step_ns, self.state = arrival, JOINED
            return IN_STEP
        if self.settings.keeps_time:
            return IN_STEP
        if not self._yields_to(origin_ns, arrival):
            if not near and p.steady:  # it has gone to another time, and hears this agent no more
                p.near_ns = None
            return IN_STEP if near else OTHER
        self._adopt_time(self.origin_ns + apart if near else origin_ns, arrival)
        return SHIFTED if near else RESTARTED

    # How long frames are under way. What i hears of j comes later by d + o_j - o_i, what j hears of i by d + o_i - o_j.

    def _hear_delay(self, p: Peer, names: Sequence[tuple[int, int]], offset_ns: int, arrival: Ns) -> None:
        limit, target = self.settings.slot_ns // 4, 0  # without a pair the link is believed
        p.offset_ns = limited(offset_ns, limit)
        for name, late_ns in names:
            if name == self.settings.id:
                p.report_ns, p.reported_ns = limited(late_ns, limit), arrival
        if arrival - p.reported_ns > self.resting_ns:
            p.report_ns = p.sum_ns = None
        if p.report_ns is not None:
            p.sum_ns = p.offset_ns + p.report_ns
        sums = sorted(q.sum_ns for q in self.peers if q.sum_ns is not None)
        if sums:
            target = (sums[len(sums) // 2] + sums[(len(sums) - 1) // 2]) // 4
        self.flight_error_ns += limited(target - self.flight_error_ns, 1_000_000) // 64

    def _shift_delays(self, by_ns: int) -> None:
        for p in self.peers:
            p.offset_ns = None if p.offset_ns is None else p.offset_ns - by_ns
            p.report_ns = None if p.report_ns is None else p.report_ns + by_ns

    def _names(self, now: Ns) -> list[tuple[int, int]]:
        """Return heard agents in turn, by id, beginning with the last one: ids between two neighbours are not heard."""
        heard = [k for k, p in enumerate(self.peers) if p.offset_ns is not None and self._hears(p, now)]
        count = min(len(heard), self.settings.link.names)
        named = [heard[(self.name_turn + i) % len(heard)] for i in range(count)]
        if heard:
            self.name_turn = (self.name_turn + (count - 1 if count > 1 else count)) % len(heard)
        return [(k + 1, self.peers[k].offset_ns or 0) for k in named]

    # Which agents hear each other.

    def _is_recent(self, p: Peer, when: Ns | None, now: Ns) -> bool:
        return when is not None and now - when <= (self.resting_ns if p.resting else self.moving_ns)

    def _hears(self, p: Peer, now: Ns) -> bool:
        return not p.left and self._is_recent(p, p.near_ns, now)

    def _hear_contact(self, p: Peer, d: Parsed) -> None:
        most = self.settings.link.names
        p.left, rests, is_on_probation = condition_of(d.frame)
        p.resting = rests or is_on_probation
        if not most:
            return
        p.unnamed += 1
        hears = names_hear(self.settings.id, [k for k, _ in d.names if k], most)
        if not hears and most == 1 and p.unnamed > CYCLES * (self.rules.agents - 1):
            hears = -1
        p.hears_us = hears or p.hears_us
        p.unnamed = 0 if hears > 0 else p.unnamed
        if hears < 0:
            p.report_ns = p.sum_ns = None

    def _has_quorum(self, now: Ns) -> bool:
        """Whether it hears, and is heard by, enough agents that have not left; unknown ones count like the majority."""
        c, link = self.settings, self.settings.link
        others = [p for k, p in enumerate(self.peers) if k != c.id - 1 and not p.left]
        says = [p.hears_us for p in others]
        trusts = not link.names or says.count(1) > says.count(-1)
        heard_by = [p.hears_us > 0 or (trusts and not p.hears_us) for p in others]
        hears = [self._hears(p, now) for p in others]
        n = len(others)
        if self.refused_since is not None and now - self.refused_since > HALF_SECOND_NS:
            heard_by = [False] * n  # the port refuses its datagrams
        needed = c.quorum if c.quorum >= 0 else max(n - 1, min(n, 1))
        if c.quorum == SHARE:
            needed = math.ceil(n * c.quorum_share - 1e-9)
        both = sum(a and b for a, b in zip(hears, heard_by, strict=True))
        self.counts = Counts(n, sum(hears), sum(heard_by), both, needed)
        return both >= needed

    # The loop.

    def _close_slot(self) -> None:
        if self.running:
            self.agent.remember_own(self.slot, self.pending)
            self.agent.end(self.slot)
        self.running, self.frame = False, b""

    def _restart(self, now: Ns) -> None:
        """Forget all frames; the agent takes part from the next slot on."""
        if self.frame:
            self.pending = b""
        self._close_slot()
        self.slot = self._slot_at(now + self.lead_ns)
        self.first, self.newcomer, self.hovers = self.slot + 1, True, HOVERS_NEW
        self.awaits = self.has_sent = False
        self.early.clear()
        for p in self.peers:
            p.offset_ns = p.report_ns = p.sum_ns = None
            p.hears_us = 0
        self.agent.restart()

    def _receive_frame(self, slot: int, frame: bytes) -> None:
        try:
            parsed, sampled = parse(frame, slot, self.rules)
            if self.agent.present:
                self.agent.hear(parsed, sampled)
        except (Refused, Foreign):
            pass
        if self.awaits and slot >= self.slot:
            self.awaits = False

    def _find_hover_reason(self, slot: int, now: Ns) -> int:
        quorum = self._has_quorum(now)
        if now < self.same_id_until:
            return HOVERS_SAME_ID
        if self.has_sent and slot >= self.first + self.rules.agents and not self.agent.memory.probation:
            self.newcomer = False
        if self.newcomer:
            return HOVERS_NEW
        return FLIES if quorum else HOVERS_QUORUM

    def _withholds_frame(self, slot: int, now: Ns) -> bool:
        """Whether the agent does not send its frame.

        A new agent is silent while another one sends with its id: the other was here first. One that has received no
        frame for long sends half of its frames, at random: the others may collide with frames of agents whose slots
        begin at other times.
        """
        is_deaf = now - self.heard_ns > self.patience_ns and not self.settings.keeps_time
        return (self.newcomer and now < self.same_id_until) or (is_deaf and bool(self._draw(slot) & 1))

    def _open_slot(self, slot: int, now: Ns) -> None:
        self._close_slot()
        self.hovers, self.slot = self._find_hover_reason(slot, now), slot
        if self.leaving and not self.gone:  # its last frame was not sent
            self.agent.present = LEAVES
        chosen = self.agent.decide(slot).index + 1
        self.pending = self.frame = self.agent.frame(slot) if self.agent.sends else b""
        if self.frame and self._withholds_frame(slot, now):
            self.pending = self.frame = b""
        self.running, self.awaits = True, chosen not in (0, self.settings.id)
        due = [entry for entry in self.early if entry[0] <= slot]
        self.early = [entry for entry in self.early if entry[0] > slot]
        for entry in due:
            self._receive_frame(*entry)

    def receive(self, data: bytes, arrival: Ns) -> int:
        """Receive a datagram, of any bytes; return ACCEPTED, or why it is refused."""
        d = parse_datagram(data, self.settings, self.rules)
        if isinstance(d, int):
            return d
        c, slot_ns = self.settings, self.settings.slot_ns
        listens, began = self.state == LISTENING, arrival - c.link.flight_ns - d.late_ns
        start = began - self.flight_error_ns
        present = d.slot if listens else self._slot_at(start)
        slot = d.slot if listens else present + centred(d.slot - present, self.cycle)
        expected = self.slot_start_ns(slot)
        p = self.peers[d.sender - 1]
        if d.sender == c.id:
            return OTHER_TIME if listens else self._classify_own_id(data, arrival, start - expected)
        if p.last_slot == d.slot and not listens:
            return REPEATED
        p.last_slot, self.heard_ns = d.slot, arrival
        outcome = self._hear_time(p, start - slot * slot_ns, arrival)
        if outcome == OTHER:
            return OTHER_TIME
        if outcome == RESTARTED:
            slot, self.origin_ns = d.slot, start - d.slot * slot_ns
            self._restart(arrival)
        else:
            self._hear_delay(p, d.names, began - expected, arrival)
            self._shift_delays(self.slot_start_ns(slot) - expected)
        self._hear_contact(p, d)
        if slot > self.slot:
            if len(self.early) < c.early_count:
                self.early.append((slot, d.frame))
        elif slot >= self.first - 1:
            self._receive_frame(slot, d.frame)
        return ACCEPTED

    def _classify_own_id(self, data: bytes, arrival: Ns, apart: int) -> int:
        """Classify a datagram with the own id: echo or replay of an own one, or another agent with that id."""
        if data in self.sent_history:
            return REPEATED
        if abs(apart) >= self.settings.slot_ns // 2:
            return OTHER_TIME
        self.same_id_until = arrival + self.patience_ns
        return SAME_ID

    def _due_ns(self, now: Ns) -> Ns:
        if self.state == LISTENING:
            return self.deadline_ns
        if self.frame:
            return self.slot_start_ns(self.slot)
        following = self.slot_start_ns(self.slot + 1)
        must_decide = self.awaits and now >= following - self.lead_ns
        return following - (self.latest_lead_ns if must_decide else self.lead_ns)

    def step(self, now: Ns) -> tuple[Ns, bytes]:
        """Do one step that is due; return when to call again (not after now: at once), and the datagram to send."""
        datagram, due = b"", self._due_ns(now)
        if now < due:
            return due, b""
        if self.state == LISTENING:
            late_ns = self.settings.late_ns
            self.origin_ns, self.state = now - self.round_ns if late_ns is None else late_ns, ALONE
            self.in_step_ns = now
            self._restart(now)
        elif self.frame:
            datagram = self._send(now - due, now)
        elif now - self.slot_start_ns(self.slot + 1) > self.too_long_ns:
            self._restart(now)
        else:
            self._open_slot(self.slot + 1, now)
        return self._due_ns(now), datagram

    def _send(self, late_ns: int, now: Ns) -> bytes:
        if late_ns > self.latest_send_ns:  # it would disturb the next turn
            self.frame = self.pending = b""
            return b""
        slot = self.rules.slot_on_air(self.slot)
        datagram = write_datagram(self.settings, self.frame, slot, late_ns, self._names(now))
        if self.leaving and condition_of(self.frame)[0]:
            self.gone = True
        self.frame, self.has_sent = b"", True
        self.sent_history.append(datagram)
        return datagram

    def sent(self, now: Ns, taken: bool) -> None:
        """What became of the datagram that the last step gave."""
        if taken:
            self.refused_since = None
            return
        self.pending = b""
        if self.refused_since is None:
            self.refused_since = now

    def leave(self) -> None:
        """It says on the air that it leaves, where frames can say so."""
        self.leaving = True
        if self.rules.policy == "lease":
            self.agent.present = LEAVES
        else:
            self.agent.present, self.gone = OFF, True
            self.agent.restart()
