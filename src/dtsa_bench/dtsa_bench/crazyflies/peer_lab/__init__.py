"""The peer-to-peer laboratory: copies of a Crazyflie app fly in virtual time over one medium.

The app is C with a function `appMain`. It is compiled for this machine against own declarations of the firmware's
documented functions (`firmware`), and each vehicle loads a private copy. The engine (`native`, C) runs the apps' tasks;
the simulated Crazyflie is their world, the simulated radio their air. The same seed gives the same bits.
"""

from .app import App, LabSettings, read_app
from .laboratory import Laboratory

__all__ = ["App", "LabSettings", "Laboratory", "read_app"]
