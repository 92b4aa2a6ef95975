"""Faults on command: JSON objects in UDP datagrams to the fleet's control port."""

from __future__ import annotations

import json
import socket
from typing import Any

from dtsa_agent.core.errors import ConfigError

FAULTS = {
    "drop": "lose datagrams at random: rate 0..1 (default 1), direction up, down or both",
    "freeze": "the link falls silent, the Crazyflie flies on by itself",
    "close": "the socket is closed: the host's packets bounce",
    "refuse_arming": "arming requests are refused",
    "tumble": "turn over in the air: it falls",
    "estimate_jump": "the estimate is this far (distance, m, default 2) from the truth along x",
    "estimate_freeze": "the estimate does not change any more",
    "battery": "show this voltage (V, default 3.0)",
    "heal": "all of the above is over; a fallen Crazyflie is put upright",
    "reboot": "power off and on: everything is forgotten, also an emergency stop",
}


def check_fault(request: dict[str, Any], count: int) -> tuple[str, list[int]]:
    """Name and indices (from 0) that a request is about.

    :param request: `fault` and `cf` (an id from 1, a list of ids, or "all"), and the fault's own numbers.
    :param count: number of Crazyflies in the fleet.
    :raises ConfigError: it is not understood.
    """
    fault = request.get("fault")
    if fault not in FAULTS:
        raise ConfigError("fault", fault, "one of " + ", ".join(FAULTS))
    cf = request.get("cf", "all")
    ids = list(range(1, count + 1)) if cf == "all" else cf if isinstance(cf, list) else [cf]
    for i in ids:
        if not isinstance(i, int) or isinstance(i, bool) or not 1 <= i <= count:
            raise ConfigError("cf", i, f'1 to {count}, or "all"')
    for name, low, high in (
        ("rate", 0.0, 1.0),
        ("voltage", 2.0, 4.3),
        ("distance", -10.0, 10.0),
        ("seconds", 0.0, 1e6),
    ):
        value = request.get(name)
        if value is not None and not (isinstance(value, (int, float)) and low <= value <= high):
            raise ConfigError(name, value, f"{low:g} to {high:g}")
    if request.get("direction", "both") not in ("up", "down", "both"):
        raise ConfigError("direction", request["direction"], "up, down or both")
    return fault, [i - 1 for i in ids]


def send_fault(address: tuple[str, int], timeout: float = 1.0, **request: Any) -> dict[str, Any]:
    """Tell a running fleet to fail.

    :param address: host and control port. :param timeout: s.
    :param request: see `check_fault`; `seconds`: how long it lasts (default: until healed).
    :return: the fleet's answer: `ok`, and `error` or the fleet's time `t`.
    :raises ConfigError: nobody answers, or the request was refused.
    """
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sock:
        sock.settimeout(timeout)
        sock.connect(address)
        try:
            sock.send(json.dumps(request).encode())
            answer: dict[str, Any] = json.loads(sock.recv(2048))
        except OSError as error:
            where = f"{address[0]}:{address[1]}"
            raise ConfigError("control_port", where, "the control port of a running fleet") from error
    if not answer.get("ok"):
        raise ConfigError(answer.get("field", "fault"), answer.get("value"), answer.get("allowed", "?"))
    return answer
