"""What the simulated radios are made of."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path

from dtsa_agent.core.errors import ConfigError
from dtsa_agent.core.settings.declaration import Settings, check, setting

DEVICES = {"pa": 0x0301, "2": 0x0504}  # Crazyradio PA, Crazyradio 2.0: version of the firmware as USB says it


@dataclass(frozen=True, slots=True)
class Station:
    """Where one Crazyflie listens."""

    uri: str = "radio://0/80/2M"
    channel: int = 80
    rate: str = "2M"
    address: bytes = b"\xe7\xe7\xe7\xe7\xe7"

    @classmethod
    def of(cls, uri: str) -> Station:
        """The station of a URI such as radio://0/80/2M/E7E7E7E701.

        :raises ConfigError: it is not of that kind.
        """
        parts = uri.partition("?")[0].removeprefix("radio://").split("/")
        if not uri.startswith("radio://") or len(parts) != 4:
            raise ConfigError("uri", uri, "radio://RADIO/CHANNEL/RATE/ADDRESS for a simulated radio")
        return cls(uri, int(parts[1]), parts[2], bytes.fromhex(parts[3]))


@dataclass(frozen=True, slots=True)
class RadioSettings(Settings):
    """Dongles and air.

    :param path: the Unix socket to which hosts connect; None: no radios.
    :param stations: where each Crazyflie listens.
    """

    dongles: int = setting(4, "number of simulated Crazyradios", minimum=1, maximum=16)
    device: str = setting("2", "kind of the dongles: Crazyradio PA, or Crazyradio 2.0", choices=tuple(DEVICES))
    loss: float = setting(
        0.0, "share of packets, and of acknowledgements, that are lost on the air", minimum=0.0, maximum=1.0
    )
    seed: int = setting(1, "seed of the losses on the air", minimum=0, maximum=2**63 - 1)
    usb_ms: float = setting(
        0.2, "turn-round of a packet on USB, both ways together", unit="ms", minimum=0.0, maximum=100.0
    )
    request_ms: float = setting(
        1.0, "a request on USB that sets channel, address or data rate", unit="ms", minimum=0.0, maximum=100.0
    )
    path: Path | None = None
    stations: tuple[Station, ...] = field(default=())

    def __post_init__(self) -> None:
        check(self)
