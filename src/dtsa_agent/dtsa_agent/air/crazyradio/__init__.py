"""The port that carries an agent's datagrams by a Crazyradio 2.0, as broadcasts between Crazyflies."""

from .port import CrazyradioPort
from .settings import CrazyradioSettings

__all__ = ["CrazyradioPort", "CrazyradioSettings"]
