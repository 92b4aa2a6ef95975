"""A process that only wakes once a slot, with an agent's priority: how late it wakes is the machine's doing.

`python -m dtsa_dev.soak.air.bare_timer SLOT_NS SECONDS` prints how late it woke, ns, as a JSON list.
"""

from __future__ import annotations

import json
import sys
import time

from dtsa_agent.air.precision import going_first, wake_precisely

PRIORITY = 20  # as of agents


def late_ns(slot_ns: int, seconds: float) -> list[int]:
    """How late it wakes, ns, in each slot.

    :param slot_ns: ns, from one wake-up to the next.
    :param seconds: s, how long.
    """
    wake_precisely()
    found, begin = [], time.monotonic_ns()
    with going_first(PRIORITY):
        for slot in range(1, round(seconds * 1e9 / slot_ns) + 1):
            due = begin + slot * slot_ns
            time.sleep(max(0, due - time.monotonic_ns()) / 1e9)
            found.append(time.monotonic_ns() - due)
    return found


if __name__ == "__main__":
    print(json.dumps(late_ns(int(sys.argv[1]), float(sys.argv[2]))))
