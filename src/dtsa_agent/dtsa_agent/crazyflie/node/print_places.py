"""Where the Crazyflies of a swarm stand: connects, prints their places as JSON (m, world), and ends.

`python -m dtsa_agent.crazyflie.node.print_places --ros-args -p config:=swarm.yaml`. No motor turns, and the emergency
watchdog is not begun.
"""

from __future__ import annotations

import json
import sys

from dtsa_agent.crazyflie.state.state_machine import State

from .bridge_node import BridgeNode, main


def where(node: BridgeNode) -> int:
    """Print the places of those that are ready; exit code 1 if somebody is not."""
    if node.positions is not None:
        node.positions.start()
    node.bridge.connect()
    found = {s.name: s.vehicle.position for s in node.bridge.snapshots() if s.state == State.READY and s.vehicle}
    node.bridge.close()
    print(json.dumps(found), flush=True)
    return int(len(found) < len(node.settings.robots))


if __name__ == "__main__":
    sys.exit(main(None, where))
