"""The modem that carries the frames of a swarm, and the serial line to it."""

from __future__ import annotations

from dataclasses import dataclass

from dtsa_agent.air.port import PortProperties
from dtsa_agent.core.errors import ConfigError
from dtsa_agent.core.settings.declaration import REQUIRED, Settings, check, setting

from .lengths import LONGEST, OVERHEAD
from .modems import MODEMS, NONE, Modem

_SECOND = 1_000_000_000
_BITS = 10  # of a byte on the line
_SHORT, _LONG = 40, 140  # bytes between which the time of a byte on the air is taken: LoRa sends blocks of them


@dataclass(frozen=True, slots=True)
class SerialSettings(Settings):
    """Where the frames of a swarm go.

    :raises ConfigError: at creation, naming the field, the value and what is allowed.
    """

    device: str = setting(REQUIRED, "the serial device of the modem, as /dev/ttyUSB0", custom=True)
    baud: int = setting(57_600, "speed of the line to the modem", unit="bit/s", minimum=1200, maximum=4_000_000)
    modem: str = setting(NONE, "the modem, from whose times arrivals are corrected", choices=tuple(MODEMS))
    modem_time_ns: int | None = setting(
        None,
        "what the modem takes for a packet without the time of its bytes; default: as of its kind",
        unit="ns",
        minimum=0,
        maximum=10 * _SECOND,
    )
    air_byte_ns: int | None = setting(
        None, "what each byte takes on the air; default: as of its kind", unit="ns", minimum=0, maximum=_SECOND
    )

    def __post_init__(self) -> None:
        check(self)
        if not isinstance(self.device, str) or not self.device or "\0" in self.device:
            raise ConfigError("device", self.device, "the serial device of the modem, as /dev/ttyUSB0")

    @property
    def kind(self) -> Modem:
        """The modem's row."""
        return MODEMS[self.modem]

    @property
    def line_byte_ns(self) -> int:
        """What a byte takes on the line."""
        return _BITS * _SECOND // self.baud

    @property
    def properties(self) -> PortProperties:
        """What agents, listeners and bags must know of it."""
        kind, line_ns = self.kind, self.line_byte_ns
        byte_ns = (kind.on_air_ns(_LONG) - kind.on_air_ns(_SHORT)) // (_LONG - _SHORT)
        modem_ns = kind.turn_round_ns + kind.on_air_ns(_SHORT) - byte_ns * _SHORT
        if self.air_byte_ns is not None:
            byte_ns = self.air_byte_ns
        if self.modem_time_ns is not None:
            modem_ns = self.modem_time_ns
        each_ns = 2 * line_ns + byte_ns  # a modem sends what it has whole, and so does the one that receives it
        fixed_ns = modem_ns + kind.gap_bytes * line_ns + OVERHEAD * each_ns
        return PortProperties(
            "serial",
            fixed_ns,
            each_ns,
            agreed_bytes=2,
            peers=1,
            longest=min(LONGEST, kind.packet - OVERHEAD),
            turn_ns=kind.turn_ns,
            slots_hold_flights=True,
            varies=True,
        )

    @property
    def where(self) -> str:
        """Where the frames go, for people."""
        return f"{self.device} at {self.baud} baud, modem {self.modem}"
