"""The peer-to-peer laboratory: copies of a Crazyflie app (C, a function `appMain`) fly in virtual time over one medium.

The app is compiled for this machine against own declarations of the firmware's documented functions (`firmware`). The
engine (`native`, C) runs the apps' tasks; the simulated Crazyflie is their world, the simulated radio their air.
"""

from .app import App, LabSettings, read_app
from .laboratory import Laboratory

__all__ = ["App", "LabSettings", "Laboratory", "read_app"]
