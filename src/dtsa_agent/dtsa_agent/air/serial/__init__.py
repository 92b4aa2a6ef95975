"""The port that carries an agent's datagrams over a modem on a serial line. It was never run on hardware.

Modems that hand on what they are given, to all others alike: SiK and RFD900 in multipoint mode, LoRa modules, XBees,
bridges to ESP-NOW.
"""

from .settings import SerialSettings

__all__ = ["SerialSettings"]
