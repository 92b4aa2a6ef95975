"""A foreign node: publishes what does not belong there into a live flight. Run as a process of its own.

    python -m dtsa_dev.soak.intruder TOPIC TYPE KIND SEED

Kinds: ``bytes`` (no message of the type), ``default`` (all fields empty), ``random`` (fields of random length and
value, made from the message's definition), ``again`` (what it hears on the topic, once more), ``foreign`` (what it
hears, with the id of another run).
"""

from __future__ import annotations

import importlib
import random
import struct
import sys
import time
from array import array
from typing import Any

import rclpy
from rclpy.qos import QoSProfile
from rclpy.serialization import serialize_message

from dtsa_agent.ros.common.wire.packing import RUN_BYTES

SECONDS = 3.0
_FOUND_S = 2.0  # s until somebody is on the topic; there may be nobody
_PAUSE_S = 0.01
_LONGEST = 40  # entries of a random array


def random_message(kind: Any, pick: random.Random) -> Any:
    """A well-formed message with fields of random length and value.

    :param kind: its class.
    :param pick: where chance comes from.
    """
    message = kind()
    for name, spec in kind.get_fields_and_field_types().items():
        setattr(message, name, _random_value(spec, getattr(message, name), pick))
    return message


def _random_value(spec: str, default: Any, pick: random.Random) -> Any:
    if spec.startswith("sequence<"):
        inner = spec[len("sequence<") : -1].partition(",")[0]
        values = [_random_number(inner, pick) for _ in range(pick.choice((0, 1, 2, pick.randrange(_LONGEST))))]
        if inner == "string":
            return [str(value) for value in values]
        if isinstance(default, array):
            return array(default.typecode, values)
        return default
    if "/" in spec:
        return random_message(type(default), pick)
    if "[" in spec:
        return default
    return str(_random_number(spec, pick)) if spec == "string" else _random_number(spec, pick)


def _random_number(spec: str, pick: random.Random) -> Any:
    if spec in ("float", "double"):
        return pick.choice((0.0, -1.0, 1e30, float("nan"), float("inf"), pick.gauss(0.0, 1.0)))
    if spec == "boolean":
        return pick.random() < 0.5
    digits = "".join(letter for letter in spec if letter.isdigit())
    bits = int(digits) if digits else 8
    unsigned = spec.startswith("u") or spec in ("octet", "char")
    low, high = (0, 2**bits - 1) if unsigned else (-(2 ** (bits - 1)), 2 ** (bits - 1) - 1)
    value = pick.choice((low, high, 0, 1, 2, 3, pick.randint(low, high)))
    return bytes([value]) if spec == "octet" else value


def main(words: list[str]) -> int:
    """Publishes for a few seconds; prints how many messages."""
    topic, name, what, seed = words
    package, _, kind_name = name.rpartition("/")
    kind = getattr(importlib.import_module(package.replace("/", ".")), kind_name)
    pick = random.Random(f"{topic} {what} {seed}")
    rclpy.init()
    node = rclpy.create_node("intruder")
    publisher = node.create_publisher(kind, topic, QoSProfile(depth=100))
    sent = 0

    def publish(data: bytes) -> None:
        nonlocal sent
        publisher.publish(data)
        sent += 1

    def heard(data: bytes) -> None:
        if what == "again":
            publish(data)
            return
        changed = bytearray(data)
        changed[RUN_BYTES] = struct.pack("<I", pick.randrange(1, 2**32))
        publish(bytes(changed))

    if what in ("again", "foreign"):
        node.create_subscription(kind, topic, heard, QoSProfile(depth=100), raw=True)
    found_by = time.monotonic() + _FOUND_S
    while not publisher.get_subscription_count() and time.monotonic() < found_by:
        time.sleep(_PAUSE_S)
    end = time.monotonic() + SECONDS
    while time.monotonic() < end and sent < 2000:
        if what == "bytes":
            publish(bytes([0, 1, 0, 0]) + pick.randbytes(pick.randrange(200)))
        elif what == "default":
            publish(bytes(serialize_message(kind())))
        elif what == "random":
            publish(bytes(serialize_message(random_message(kind, pick))))
        rclpy.spin_once(node, timeout_sec=_PAUSE_S)
    print(sent)
    rclpy.try_shutdown()
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
