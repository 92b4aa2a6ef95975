"""The port through which an agent's frames get on an air: simulated, or a real radio or network."""

from .port import AirListener, AirPort, SlotHearing

__all__ = ["AirListener", "AirPort", "SlotHearing"]
