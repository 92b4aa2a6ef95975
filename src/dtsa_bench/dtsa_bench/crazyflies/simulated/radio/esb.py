"""Times and sizes on the air between a Crazyradio and a Crazyflie (Nordic's Enhanced ShockBurst)."""

from __future__ import annotations

from dtsa_channel_sim.model.airtime import OVERHEAD_BITS

BITRATES = {"250K": 250_000, "1M": 1_000_000, "2M": 2_000_000}
RATE_NAMES = tuple(BITRATES)  # by the number of the dongle's request SET_DATA_RATE
TURN_NS = 130_000  # a radio turns from receiving to sending, or starts to send
MAX_PAYLOAD = 32  # bytes of a packet, and of an acknowledgement
MAX_SNIFFED = 63  # bytes of a packet in sniffer mode: all that its length field can name
BROADCAST = bytes.fromhex("FFE7E7E7E7")  # every Crazyflie listens to it, and acknowledges nothing
PEER_HEAD, PEER_PORT = 0xF3, 0x80  # bits of the first two bytes of a broadcast between Crazyflies
# Payload of an acknowledgement that fits into 1, 2, ... steps of the nRF24LU1+'s retry delay, by data rate.
_ARD_STEPS = {"250K": (0, 0, 8, 16, 24, 32), "1M": (15, 32), "2M": (5, 32)}
_ARD_STEP_NS = 250_000


def on_air_ns(length: int, rate: str) -> int:
    """Time that the bits of a packet (0 to 63 bytes of payload) are on air, ns; the rate is a key of BITRATES."""
    return (OVERHEAD_BITS + 8 * length) * 1_000_000_000 // BITRATES[rate]


def retry_delay_ns(ard: int, rate: str) -> int:
    """How long a Crazyradio PA waits for an acknowledgement, ns from the end of its packet.

    :param ard: value of the request SET_RADIO_ARD: steps of 250 us, or with bit 7 the bytes of an acknowledgement.
    """
    if not ard & 0x80:
        return _ARD_STEP_NS * ((ard & 0x0F) + 1)
    wanted = min(ard & 0x7F, MAX_PAYLOAD)
    steps = next(i for i, fits in enumerate(_ARD_STEPS[rate]) if fits >= wanted)
    return _ARD_STEP_NS * (steps + 1)


def between_crazyflies(packet: bytes) -> bool:
    """Whether a packet is peer-to-peer: the radio chip does not take it for the ground station's."""
    return len(packet) > 1 and packet[0] & PEER_HEAD == PEER_HEAD and packet[1] & 0xF0 == PEER_PORT
