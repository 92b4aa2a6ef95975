"""The laboratory in real time: programs of the ground connect to its simulated Crazyradios.

The bridge and every other program with cflib talks to the vehicles by CRTP, with the app's parameters, log variables
and app channel. Dongles in sniffer mode hear what the apps send to each other, and take part. Times on the air are as
exact as in virtual time; only the programs see them as late as this machine is. On a machine that is too busy the
laboratory is slower than real time: caught up at once, the lost time would be a gap of all links.

    python -m live_helpers SOCKET OUT APP AGENTS|SWARM.json    # until SIGINT; prints the summary as JSON
"""

from __future__ import annotations

import json
import os
import selectors
import signal
import subprocess
import sys
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from typing import Any

from waiting import wait_for

from dtsa_agent.core import SwarmConfig
from dtsa_agent.crazyflie.addresses import Address, parse_address
from dtsa_agent.crazyflie.onboard import key_of
from dtsa_bench.crazyflies.peer_lab import App, Laboratory, LabSettings, read_app
from dtsa_bench.crazyflies.peer_lab.laboratory import ADDRESS, TICK_NS
from dtsa_bench.crazyflies.peer_lab.onboard import OnboardSwarm
from dtsa_bench.crazyflies.peer_lab.record import Observer, PeerPacket
from dtsa_bench.crazyflies.simulated import crtp
from dtsa_bench.crazyflies.simulated.fleet_config import RadioSettings
from dtsa_bench.crazyflies.simulated.radio.air import BROADCAST, PEER_PORT, Tuning
from dtsa_bench.crazyflies.simulated.radio.side import RadioServer
from dtsa_channel_sim.model.medium import OnAir

WAIT_S = 0.001
BEHIND_NS = 20_000_000  # caught up at once; what is more is lost
APP_CHANNEL = 2  # of CRTP's platform port


def station(settings: LabSettings, agent: int) -> Address:
    return parse_address(f"radio://0/{settings.channel}/{settings.rate}/{ADDRESS + agent:010X}")


class LiveLaboratory(Laboratory):
    """A laboratory with dongles on its air."""

    def __init__(
        self, path: Path, dongles: int, app: App, settings: LabSettings, out: Path | None = None,
        observers: Sequence[Observer] = (),
    ) -> None:  # fmt: skip
        stations = tuple(station(settings, agent) for agent in range(1, settings.agents + 1))
        radio = RadioSettings(dongles=dongles, path=path, stations=stations, loss=settings.loss, seed=settings.seed)
        self.server = RadioServer(radio, self._hear_ground, lambda index, up: self.is_on(index + 1))
        self._ticks = 0
        self._stopped = False
        more = [*observers, self._answer_ground]
        super().__init__(app, settings, out, more, self.server.air, self.server.first)
        for agent, receiver in enumerate(self.server.receivers, 1):
            receiver.on_packet = partial(self.receive_poll, agent)
        self.air.peer_packet = self._between
        self.agenda.at(TICK_NS, self._log)

    def stop(self) -> None:
        """End :meth:`fly`; also from a signal's handler."""
        self._stopped = True

    def fly(self, seconds: float) -> None:
        selector = selectors.SelectSelector()  # waits to the microsecond; epoll to the millisecond
        self.server.listen(selector)  # not before: the app has been compiled
        while not self._stopped and self.time < seconds:
            for key, _ in selector.select(WAIT_S):
                key.data()
            self.server.origin_ns += max(0, self.server.now_ns() - self.now_ns - BEHIND_NS)
            self.run(min(seconds, self.server.now_ns() / 1e9))

    def close(self) -> None:
        super().close()
        self.server.close()

    # -- between ground and apps ------------------------------------------------------------------------------------
    def _hear_ground(self, index: int, packet: bytes, t: float) -> None:
        reply = self.peers[index].receive(packet, t)
        if reply is not None:
            self.server.receivers[index].push(reply)
        self.update_app(index)

    def deliver_packet(self, packet: PeerPacket, heard: set[int], frame: OnAir) -> None:
        if packet.sender:  # dongles in sniffer mode have it, too
            payload = bytes((0xFF, PEER_PORT | packet.raw[0])) + packet.data
            tuning = Tuning(self.settings.channel, self.settings.rate, (BROADCAST, BROADCAST))
            self.air.sniff(heard, BROADCAST, payload, tuning, frame)
        super().deliver_packet(packet, heard, frame)

    def _between(self, packet: bytes, heard: set[int], tuning: Tuning, frame: OnAir) -> None:
        if tuning[:2] == (self.settings.channel, self.settings.rate):
            self.deliver_packet(PeerPacket(0, bytes((packet[1] & 0x0F,)) + packet[2:], 0), heard, frame)

    def _answer_ground(self, kind: str, agent: int, now_ns: int, content: Any) -> None:
        if kind == "app_channel":
            self.server.receivers[agent - 1].push(crtp.pack(crtp.PLATFORM, APP_CHANNEL, content))
        elif kind == "print":
            data = content.encode()
            for first in range(0, len(data), crtp.MAX_DATA):
                self.server.receivers[agent - 1].push(crtp.pack(crtp.CONSOLE, 0, data[first : first + crtp.MAX_DATA]))

    def _log(self) -> None:
        self._ticks += 1
        now = self._ticks * TICK_NS
        self.agenda.at(now + TICK_NS, self._log)
        for index, (peer, receiver) in enumerate(zip(self.peers, self.server.receivers, strict=True)):
            if not peer.blocks or not self.is_on(index + 1):
                continue
            if not receiver.connected(now / 1e9):  # no host: the log ends
                peer.blocks.clear()
                continue
            for packet in peer.log_packets(self._ticks, now / 1e9):
                receiver.push(packet)


def main() -> int:
    place, out, what, *more = sys.argv[1:]
    flight: Any
    if what.endswith(".json"):
        swarm = SwarmConfig.from_dict(json.loads(Path(what).read_text(encoding="utf-8")))
        # The protocol on board, with dongles on its air; the ground is a program there.
        make = partial(LiveLaboratory, Path(place), 3)
        flight = OnboardSwarm(swarm, LabSettings(boot_s=0.1), Path(out), key_of(swarm), enable_s=None, make=make)
        lab: Any = flight.lab
    else:
        flight = lab = LiveLaboratory(Path(place), 3, read_app(what), LabSettings(agents=int(more[0])))
    signal.signal(signal.SIGINT, lambda *_: lab.stop())
    with flight:
        lab.fly(600.0)
        summary = flight.summary()
    print(json.dumps(summary))
    return 0


@contextmanager
def live_laboratory(folder: Path, *what: str, **environment: str) -> Iterator[subprocess.Popen[str]]:
    """The laboratory in a process of its own; its socket is `radio` in the folder, which gets its files, too."""
    place, tests = folder / "radio", str(Path(__file__).parent)
    more = {**environment, "PYTHONPATH": os.pathsep.join([*sys.path, tests])}
    command = [sys.executable, "-m", "live_helpers", str(place), str(folder), *what]
    process = subprocess.Popen(command, stdout=subprocess.PIPE, text=True, env=os.environ | more)
    try:
        wait_for(lambda: place.exists() or process.poll() is not None)
        yield process
    finally:
        process.kill()
        process.wait()
        if process.stdout is not None:
            process.stdout.close()


if __name__ == "__main__":
    sys.exit(main())
