"""The simulated radio by itself: dongle, air and receivers in simulated time, without cflib."""

from __future__ import annotations

from dataclasses import dataclass, field

import pytest

from dtsa_agent.crazyflie import addresses as budget
from dtsa_agent.crazyflie.addresses import Address
from dtsa_bench.crazyflies.simulated.fleet_config import RadioSettings
from dtsa_bench.crazyflies.simulated.radio import dongle as requests
from dtsa_bench.crazyflies.simulated.radio.air import BITRATES, BROADCAST, RATE_NAMES, RadioAir
from dtsa_bench.crazyflies.simulated.radio.dongle import DongleModel
from dtsa_bench.crazyflies.simulated.radio.receiver import QUEUE, RadioReceiver

NULL, SAFELINK = b"\xff", b"\xff\x05\x01"
PACKET = b"\x3c" + bytes(14)
US = 1000
SHARED = budget.parse_address("radio://0/80/2M/FFE7E7E7E7")
TWO = RadioSettings(dongles=2, request_ms=0.0)


def station(number: int, channel: int = 80, rate: str = "2M") -> Address:
    return budget.parse_address(f"radio://0/{channel}/{rate}/E7E7E7E7{number:02X}")


@dataclass
class Room:
    settings: RadioSettings = TWO
    stations: tuple[Address, ...] = (station(1), station(2))
    heard: list[tuple[int, bytes]] = field(default_factory=list)
    deaf: set[tuple[int, bool]] = field(default_factory=set)  # index, up: what a fault stops

    def __post_init__(self) -> None:
        first = self.settings.dongles + 1
        self.receivers = [
            RadioReceiver(s, lambda packet, t, k=k: self.heard.append((k, packet))) for k, s in enumerate(self.stations)
        ]
        air = RadioAir(first - 1 + len(self.receivers), self.settings.loss, self.settings.seed)
        air.receivers, air.passes, self.agenda = dict(enumerate(self.receivers, first)), self._hears, air.agenda
        self.dongles = [DongleModel(k, self.settings, air) for k in range(1, first)]

    def _hears(self, radio: int, up: bool) -> bool:
        return (radio - self.settings.dongles - 1, up) not in self.deaf

    def tune(self, dongle: int, to: Address) -> None:
        d = self.dongles[dongle]
        d.request(requests.SET_CHANNEL, to.channel, b"", 0)
        d.request(requests.SET_ADDRESS, 0, bytes.fromhex(to.node), 0)
        d.request(requests.SET_RATE, RATE_NAMES.index(to.rate), b"", 0)

    def exchange(self, packet: bytes, at_ns: int = 0, dongle: int = 0) -> list[tuple[int, bytes]]:
        """When the answer to a packet came (ns), and the answer."""
        answers: list[tuple[int, bytes]] = []
        self.dongles[dongle].transfer(packet, at_ns, lambda data: answers.append((self.now, data)))
        self.run()
        return answers

    def run(self) -> None:
        while (due := self.agenda.next_ns) is not None:
            self.now = due
            self.agenda.run(due)


def test_a_packet_takes_its_time_on_the_air() -> None:
    room = Room()
    room.tune(0, room.stations[0])
    ((when, answer),) = room.exchange(PACKET)
    assert answer == bytes((0x03, 0xF3, 0x01, 45)), "acknowledged, no retry, an empty packet with the signal's strength"
    bits = 2 * 73 + 8 * (15 + 3)
    assert when == 200 * US + 2 * 130 * US + bits * 500
    assert room.heard == [(0, PACKET)]
    room.tune(0, station(9))
    ((missed, answer),) = room.exchange(PACKET, at_ns=when)
    assert answer == b"\0"
    assert missed - when == 200 * US + 4 * (130 + (73 + 120) / 2 + 500) * US, "once and three times more"


def test_acknowledgements_carry_what_waits_and_safelink_repeats_what_was_lost() -> None:
    room = Room()
    room.tune(0, room.stations[0])
    receiver = room.receivers[0]
    assert room.exchange(SAFELINK)[0][1] == b"\x03" + SAFELINK
    for k in range(QUEUE + 5):
        receiver.push(bytes((0x50, k % 256)))
    assert receiver.waiting == QUEUE
    up = down = 0
    fetched: list[int] = []
    lost = 0
    for number in range(40):
        header = 0xF3 & 0x3C | up << 3 | down << 2
        room.deaf = {(0, False)} if number % 5 == 2 else set()  # these acknowledgements are lost, all four of them
        ((_, answer),) = room.exchange(bytes((header, number)))
        if answer == b"\0":
            lost += 1
            continue  # cflib sends the same packet again
        if len(answer) > 1 and bool(answer[1] & 4) == bool(down):
            down = 1 - down
        up = 1 - up
        if answer[1] >> 4 == 5:
            fetched.append(answer[2])
    assert lost == 8
    numbers = [packet[1] for _, packet in room.heard]
    assert numbers == sorted(set(numbers)), "nothing was delivered twice"
    assert fetched == list(range(len(fetched)))
    assert len(fetched) > 20, "nothing got lost on the way down"


def test_two_dongles_on_one_channel_collide_and_on_two_channels_do_not() -> None:
    for channel, retries in ((80, {1, 2, 3}), (60, {0})):
        room = Room(RadioSettings(dongles=2, device="pa"), (station(1), station(2, channel)))
        answers: list[bytes] = []
        for dongle in (0, 1):
            room.tune(dongle, room.stations[dongle])
            # the second one begins while the first one's packet is on the air
            room.dongles[dongle].transfer(PACKET, 50 * US * dongle, answers.append)
        room.run()
        assert len(answers) == 2
        assert {answer[0] >> 4 for answer in answers if answer != b"\0"} <= retries
        assert (b"\0" in answers) == (channel == 80), "with equal delays two PAs disturb each other every time"


def test_a_broadcast_reaches_all_on_its_channel_and_is_not_answered() -> None:
    room = Room(stations=(station(1), station(2), station(3, 60), station(4, 80, "1M")))
    room.tune(0, SHARED)
    room.dongles[0].request(requests.ACK_ENABLE, 0, b"", 0)
    assert room.exchange(PACKET) == []
    assert room.exchange(PACKET[:16] * 2 + bytes(10)) == [], "more than 32 bytes: two packets"
    assert [k for k, _ in room.heard] == [0, 1, 0, 1, 0, 1]


def test_losses_come_from_the_seed_and_are_as_many_as_were_ordered() -> None:
    def acknowledged(seed: int) -> list[bool]:
        room = Room(RadioSettings(dongles=1, request_ms=0.0, loss=0.3, seed=seed), (station(1),))
        room.tune(0, room.stations[0])
        room.dongles[0].request(6, 0, b"", 0)  # no retries
        return [room.exchange(NULL, at_ns=k * 10_000 * US)[0][1] != b"\0" for k in range(400)]

    first = acknowledged(7)
    assert first == acknowledged(7) != acknowledged(8)
    assert sum(first) / 400 == pytest.approx(0.7 * 0.7, abs=0.08)


@pytest.mark.parametrize("rate", list(BITRATES))
@pytest.mark.parametrize("count", [1, 4])
def test_the_bridges_budget_is_what_a_dongle_carries(rate: str, count: int) -> None:
    """One exchange after the other, as cflib does it, for half a second."""
    stations = tuple(station(k, 80, rate) for k in range(1, count + 1))
    room = Room(RadioSettings(dongles=1, device="pa"), stations)
    now = exchanges = 0
    room.tune(0, stations[0])
    now = 3_000 * US
    while now < 503_000 * US:
        to = exchanges % count
        if count > 1:
            room.dongles[0].request(requests.SET_ADDRESS, 0, room.receivers[to].address, now)
        room.receivers[to].push(bytes((0x5C,)) + bytes(budget.DOWN_BYTES - 1))
        ((now, answer),) = room.exchange(bytes((0x7C,)) + bytes(budget.UP_BYTES - 1), now)
        assert answer[0] & 1
        exchanges += 1
    assert exchanges / 0.5 == pytest.approx(1 / budget.exchange_s(rate, shared=count > 1), rel=0.03)


def test_what_the_devices_cannot_do() -> None:
    for device, rate, channel, there in (("2", "250K", 80, False), ("pa", "250K", 80, True), ("2", "1M", 110, False)):
        room = Room(RadioSettings(dongles=1, device=device), (station(1, channel, rate),))
        room.tune(0, room.stations[0])
        assert (room.exchange(PACKET)[0][1] != b"\0") is there, (device, rate, channel)
    room = Room(RadioSettings(dongles=2, device="pa"), ())
    room.dongles[0].request(requests.SET_RADIO_MODE, 1, b"", 0)
    assert room.dongles[0].sniffer.tuning is None


SPOKEN = bytes((0xFF, 0x87)) + bytes(range(60))
THREE = RadioSettings(dongles=3, request_ms=0.0)


@dataclass
class Ears:
    """What a host reads of a dongle in sniffer mode, as long as it reads."""

    dongle: DongleModel
    room: Room
    reads: bool = True
    packets: list[tuple[int, bytes]] = field(default_factory=list)

    def __post_init__(self) -> None:
        self.room.now = 0
        self.dongle.request(requests.SET_RADIO_MODE, 1, b"", 0)
        self.dongle.sniffer.give = self._take
        if self.reads:
            self.dongle.sniffer.read()

    def _take(self, data: bytes) -> None:
        self.packets.append((self.room.now, data))
        if self.reads:
            self.dongle.sniffer.read()

    @property
    def payloads(self) -> list[bytes]:
        return [data[7:] for _, data in self.packets]


def sniffing(settings: RadioSettings = THREE, stations: tuple[Address, ...] = ()) -> tuple[Room, list[Ears]]:
    room = Room(settings, stations)
    for k in range(settings.dongles):
        room.tune(k, SHARED)
    return room, [Ears(dongle, room) for dongle in room.dongles]


def test_in_sniffer_mode_a_packet_leaves_within_a_millisecond_and_others_hear_it_whole() -> None:
    waits = []
    for seed in range(20):
        room, (one, two, three) = sniffing(RadioSettings(dongles=3, request_ms=0.0, seed=seed))
        assert room.exchange(BROADCAST + SPOKEN, at_ns=5_000 * US) == []
        assert one.packets == []
        assert two.payloads == three.payloads == [SPOKEN]
        ((when, data),) = two.packets
        assert data[:3] == bytes((7 + 62, 45, 0))
        on_air = (73 + 8 * 62) * 500
        whole = when - 100 * US  # USB, one way
        assert int.from_bytes(data[3:7], "little") == pytest.approx(whole / US, abs=2)
        waits.append(whole - on_air - 5_100 * US)
    assert min(waits) >= 214 * US + 130 * US
    assert max(waits) <= 1_040 * US + 245 * US + 130 * US
    assert max(waits) - min(waits) > 500 * US, "nobody knows when"


def test_who_sends_is_deaf_and_two_at_a_time_destroy_each_other() -> None:
    room, ears = sniffing(RadioSettings(dongles=3, request_ms=0.0, seed=5))
    lost = 0
    for number in range(40):
        at = 5_000 * US * (number + 1)
        for dongle in (0, 1):
            room.dongles[dongle].transfer(BROADCAST + SPOKEN[:2] + bytes((number, dongle)), at, lambda _: None)
        room.run()
        heard = [{p[3] for p in each.payloads if p[2] == number} for each in ears]
        assert heard[0] <= {1}
        assert heard[1] <= {0}
        lost += len(heard[2]) < 2
        assert len(heard[2]) != 1 or not heard[0] & heard[1], "the third one has missed what overlapped for all"
    assert 5 < lost < 40


def test_packets_that_are_not_fetched_wait_and_more_than_eight_are_dropped_and_counted() -> None:
    room = Room(THREE, ())
    for k in (0, 1):
        room.tune(k, SHARED)
    ears = Ears(room.dongles[1], room, reads=False)
    Ears(room.dongles[0], room)
    for number in range(12):
        room.exchange(BROADCAST + SPOKEN[:2] + bytes((number,)), at_ns=5_000 * US * (number + 1))
    assert ears.packets == []
    assert room.dongles[1].sniffer.dropped == 4
    ears.reads = True
    room.dongles[1].sniffer.read()
    assert [p[2] for p in ears.payloads] == list(range(8))
    for mode in (0, 1):
        ears.dongle.request(requests.SET_RADIO_MODE, mode, b"", 0)
    assert ears.dongle.sniffer.dropped == 0


def test_a_sniffer_hears_its_two_addresses_and_broadcasts_are_not_for_the_ground_link() -> None:
    room = Room(THREE, (station(1), station(2)))
    room.tune(0, room.stations[0])
    room.tune(1, room.stations[0])
    room.dongles[1].request(requests.SET_SNIFFER_ADDRESS, 1, room.receivers[1].address, 0)
    ears = Ears(room.dongles[1], room)
    room.exchange(PACKET)
    room.tune(0, room.stations[1])
    room.exchange(PACKET, at_ns=50_000 * US)
    room.tune(0, station(9))
    room.exchange(PACKET, at_ns=100_000 * US)
    empty = bytes((0xF3, 0x01, 45))
    assert [(data[2], data[7:]) for _, data in ears.packets] == [(0, PACKET), (0, empty), (1, PACKET), (1, empty)]
    room, _ = sniffing(THREE, (station(1),))
    room.exchange(BROADCAST + SPOKEN, at_ns=5_000 * US)
    assert room.heard == []
    room.exchange(BROADCAST + PACKET, at_ns=10_000 * US)
    assert room.heard == [(0, PACKET)]
    room.exchange(BROADCAST, at_ns=15_000 * US)  # an address alone is no packet
