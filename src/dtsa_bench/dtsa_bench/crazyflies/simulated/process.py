"""Simulated Crazyflies in a process of their own: free UDP ports, start and end, and faults on command."""

from __future__ import annotations

import json
import os
import random
import socket
import subprocess
import sys
import threading
from collections.abc import Iterator, Sequence
from contextlib import ExitStack, contextmanager
from typing import Any

from dtsa_agent.core.errors import ConfigError, DtsaError
from dtsa_bench.runs.program import end_process

FIRST = 19850  # where cflib's scan looks, too
LAST = 32000  # below Linux's ephemeral ports
_RANDOM = random.SystemRandom()
_START_S = 60.0
_END_S = 10.0


def free_base_port(count: int, first: int | None = None) -> int:
    """Base port of a fleet: it, the `count` - 1 after it, and the control port before it are free now.

    :param first: the lowest base port that will do; None: any, so that two processes that search at once seldom agree.
    :raises ConfigError: there are not so many free ports in a row.
    """
    low = FIRST if first is None else first
    bases = range(low, LAST - count, count + 1)
    offset = _RANDOM.randrange(len(bases)) if first is None else 0
    for base in (*bases[offset:], *bases[:offset]):
        if _are_free(base - 1, base + count):
            return base
    raise ConfigError("port", low, f"{count + 1} free UDP ports in a row between {low - 1} and {LAST}")


def _are_free(begin: int, end: int) -> bool:
    with ExitStack() as stack:
        try:
            for port in range(begin, end):
                stack.enter_context(socket.socket(socket.AF_INET, socket.SOCK_DGRAM)).bind(("127.0.0.1", port))
        except OSError:
            return False
    return True


class FleetError(DtsaError):
    """The simulated Crazyflies do not start; `code` is the exit code of their process."""

    def __init__(self, code: int) -> None:
        super().__init__("the simulated Crazyflies do not start")
        self.code = code


@contextmanager
def running_fleet(words: Sequence[str]) -> Iterator[str]:
    """Simulated Crazyflies (`fake-crazyflie` with these words) for as long as the context lasts.

    They end with this process, too, whatever ends it. They have a session of their own: Ctrl-C is for the program that
    flies them, and still has to land them.

    :raises FleetError: if they do not start.
    """
    process = subprocess.Popen(
        [sys.executable, "-m", "dtsa_bench", "fake-crazyflie", *words, "--quiet"],
        stdout=subprocess.PIPE,
        text=True,
        start_new_session=True,
        env=os.environ | {"DTSA_SUPERVISOR": str(os.getpid())},  # of the nodes, whose module needs rclpy
    )
    assert process.stdout is not None
    patience = threading.Timer(_START_S, process.kill)
    patience.start()
    try:
        # The addresses, then one line that says that they are there.
        line = next((line for line in process.stdout if "Ctrl-C" in line), None)
        patience.cancel()
        if line is None:
            raise FleetError(process.wait())
        yield line
    finally:
        patience.cancel()
        end_process(process, _END_S)
        process.stdout.close()


# -- faults: JSON objects in UDP datagrams to the fleet's control port -------------------------------------------------
FAULTS = {
    "drop": "lose datagrams at random: rate 0..1 (default 1), direction up, down or both",
    "freeze": "the link falls silent, the Crazyflie flies on by itself",
    "close": "the socket is closed: the host's packets bounce",
    "refuse_arming": "arming requests are refused",
    "tumble": "turn over in the air: it falls",
    "estimate_jump": "the estimate is this far (distance, m, default 2) from the truth along x",
    "estimate_freeze": "the estimate does not change any more",
    "battery": "show this voltage (V, default 3.0)",
    "unplug": "a simulated dongle (number, default 0) is pulled",
    "heal": "all of the above is over; a fallen Crazyflie is put upright",
    "reboot": "power off and on: everything is forgotten, also an emergency stop",
}


NUMBERS = {
    "rate": (0.0, 1.0), "voltage": (2.0, 4.3), "distance": (-10.0, 10.0), "dongle": (0, 15), "seconds": (0.0, 1e6),
}  # fmt: skip
DIRECTIONS = ("up", "down", "both")


def check_fault(request: dict[str, Any], count: int) -> tuple[str, list[int]]:
    """Name and indices (from 0) of a request: `fault`, `cf` (an id from 1, a list of ids, "all"), and its own numbers.

    :raises ConfigError: it is not understood.
    """
    fault = request.get("fault")
    if not isinstance(fault, str) or fault not in FAULTS:
        raise ConfigError("fault", fault, "one of " + ", ".join(FAULTS))
    cf = request.get("cf", "all")
    ids = list(range(1, count + 1)) if cf == "all" else cf if isinstance(cf, list) else [cf]
    for i in ids:
        if not isinstance(i, int) or isinstance(i, bool) or not 1 <= i <= count:
            raise ConfigError("cf", i, f'1 to {count}, or "all"')
    for name, (low, high) in NUMBERS.items():
        value = request.get(name, low)
        if not (isinstance(value, (int, float)) and low <= value <= high):
            raise ConfigError(name, value, f"{low:g} to {high:g}")
    if request.get("direction", "both") not in DIRECTIONS:
        raise ConfigError("direction", request["direction"], "up, down or both")
    return fault, [i - 1 for i in ids]


def send_fault(address: tuple[str, int], timeout: float = 1.0, **request: Any) -> dict[str, Any]:
    """Tell a running fleet to fail, for `seconds` or until healed; its answer, with its time `t`.

    :raises ConfigError: no answer from its host and control port, or the request was refused.
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
