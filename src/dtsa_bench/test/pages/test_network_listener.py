"""What a listener on a network makes of frames, without a network."""

from __future__ import annotations

import base64
import json
from collections import Counter
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dtsa_agent.air.port import link_of
from dtsa_agent.core import Frame, SwarmConfig, encode_frame
from dtsa_agent.core.station import ParsedDatagram, StationSettings
from dtsa_bench.pages.view.history import MAX_MOMENTS, RunHistory
from dtsa_bench.pages.view.network_listener import ListenedRun

CONFIG = SwarmConfig(agents=3, policy="tdma", slot_ms=50.0)
FIRST = 300


class Heard:
    def __init__(self) -> None:
        self._history = RunHistory("listener")
        self._run = ListenedRun(self._history, CONFIG, "udp", FIRST, 0)
        self._datagrams = StationSettings(CONFIG, link_of(CONFIG))

    def slots(self, first: int, end: int, senders: tuple[int, ...]) -> None:
        """Slots go by; in its turn each of the senders says that it flies along x at 1 m/s."""
        for slot in range(first, end):
            sender = slot % CONFIG.agents + 1
            now = slot * CONFIG.slot_ns
            if sender in senders:
                assert self.receive(self.datagram(slot)) == ""
            self._run.advance(Counter(), now)

    def datagram(self, slot: int) -> ParsedDatagram:
        sender = slot % CONFIG.agents + 1
        place = ((slot - FIRST) * CONFIG.slot_s, float(sender), 1.0)
        frame = encode_frame(Frame(sender, slot, 1, place, (1.0, 0.0, 0.0)))
        datagram = self._datagrams.read(self._datagrams.write(frame, slot))
        assert datagram.fault == ""
        return datagram

    def receive(self, datagram: ParsedDatagram) -> str:
        return self._run.receive(datagram, datagram.frame, 0, datagram.slot * CONFIG.slot_ns)

    def moments(self) -> list[dict[str, Any]]:
        return [json.loads(moment.text) for moment in self._history.since(0, MAX_MOMENTS)[1]]


def places(moment: dict[str, Any]) -> NDArray[np.float32]:
    return np.frombuffer(base64.b64decode(moment["place"]), "<f4").reshape(-1, 3, CONFIG.agents)[-1]


def test_who_falls_silent_is_shown_where_it_was_heard_last_and_comes_back() -> None:
    heard, lost, back = Heard(), FIRST + 30, FIRST + 330
    heard.slots(FIRST, lost, (1, 2, 3))
    heard.slots(lost, back, (1, 3))
    at_end = heard.moments()[-1]
    assert at_end["absent"] == [2]
    last = max(slot for slot in range(FIRST, lost) if slot % 3 + 1 == 2)
    np.testing.assert_allclose(places(at_end)[:, 1], ((last - FIRST) * CONFIG.slot_s, 2.0, 1.0), atol=0.01)
    others = (at_end["slot"] - FIRST) * CONFIG.slot_s
    np.testing.assert_allclose(places(at_end)[0, [0, 2]], others, atol=0.2)
    heard.slots(back, back + 30, (1, 2, 3))
    again = heard.moments()[-1]
    assert again["absent"] == []
    np.testing.assert_allclose(places(again)[0], (again["slot"] - FIRST) * CONFIG.slot_s, atol=0.2)


def test_bytes_that_are_no_frame_are_not_shown() -> None:
    """Also where a holder of the key signed them, so that the datagram is accepted."""
    heard = Heard()
    heard.slots(FIRST, FIRST + 12, (1, 2, 3))
    good = heard.datagram(FIRST + 12)
    garbage = good.frame[:8] + b"\xff" * (len(good.frame) - 8)
    assert heard.receive(good._replace(frame=garbage)) == ""
    heard.slots(FIRST + 13, FIRST + 40, ())
    sent = [np.frombuffer(base64.b64decode(moment["frames"]["slot"]), "<u4") for moment in heard.moments()]
    assert np.concatenate(sent).max() == FIRST + 11
