"""What an agent hears through its port: whose datagrams they are, what time they say it is. Compiled.

Times are ns. The plain statement of the same is :mod:`.plain_hearing`.
"""

from typing import Any

_Port = Any  # a capsule, see _hearing/port.h

_Heard = tuple[int, int, bytes, bytes, int]  # sender, slot, frame without its tag, datagram, arrival by the own clock
_Refused = tuple[int, int, bytes, int]  # number of the reason, slot (of one in the own name), datagram, arrival
_Found = tuple[list[_Heard] | None, list[_Refused] | None, bool, bool]

class Hearing:
    listening: bool  # it knows no time yet

    def __new__(
        cls, agents: int, id: int, anchor_every: int, slot_ns: int, seed: int, header: bytes, late_bytes: int,
        peers: int, key: bytes, session: int, flight_ns: int, position_step: float, length: int, own_bytes: int,
        limit_ns: int, trust_ns: int, clock_began_ns: int, clock_offset_ns: int, clock_drift_ppb: int, moving: int,
        resting: int, named: int, port: _Port, /,
    ) -> Hearing: ...  # fmt: skip

    # Sleeps until so long before a slot, a while at most. None: it is not that time yet; else as `take`.
    def listen(self, slot: int, lead_ns: int, /) -> _Found | None: ...
    # What has arrived, up to a frame with which another time is taken over: -> heard, refused, whether it is, whether
    # there may be more.
    def take(self) -> _Found: ...
    def take_one(self, data: bytes, arrival_ns: int, /) -> tuple[int, bool, _Heard | None]: ...  # CLOCK_MONOTONIC
    def sleep_until(self, slot: int, lead_ns: int, /) -> bool: ...  # as `listen`, without listening
    def await_frame(self, until_ns: int, /) -> None: ...  # CLOCK_MONOTONIC; a while at most
    def late_ns(self, slot: int, /) -> int: ...  # how long ago a slot has started
    def start(self) -> int: ...  # begins to listen; when to call `wake` at the latest, CLOCK_MONOTONIC
    def wake(self) -> bool: ...
    def hear_slot(self, slot: int, start_ns: int, /) -> int: ...  # of a time base: what it says that slots are
    def slot_at(self, local_ns: int, /) -> int: ...
    def slot_start_ns(self, slot: int, /) -> int: ...  # by the own clock
    def local_ns(self, monotonic_ns: int, /) -> int: ...
    # The datagram of an own frame, not sealed yet, with what it says of the others; how late it leaves.
    def wrap(self, frame: bytes, slot: int, late_ns: int, /) -> bytes: ...
    # -> state, restarts, corrected, corrections, error of the time under way
    def status(self) -> tuple[int, int, int, int, int]: ...
    # How it stands with the others: -> there, hears, heard by, both; see `contacts.Contacts.count`.
    def contact(self, slot: int, strict: bool, /) -> tuple[int, int, int, int]: ...
    # -> frames of about the same time; of these, off by more than a quarter of a slot
    def timing(self) -> tuple[int, int]: ...
