"""Foreign publishers in a live flight: junk of every type of message, duplicates, other runs, replayed bags."""

from __future__ import annotations

import importlib
import os
import random
import struct
import subprocess
import sys
import time
from array import array
from pathlib import Path
from typing import Any

from fly_helpers import ENDLESS, PATIENCE_S, FlightProcess, run_dtsa, start_flight

from .row import LOCKSTEP, REALTIME, Fault, FAULTS, fault  # isort: skip

_S = 3.0  # for which a foreign node publishes
_LONG_S = 30.0  # by then the first message has been received, on a busy machine
_DISCOVERY_S = 2.0  # until a subscriber is found; there may be none
_PAUSE_S = 0.01
_MOST_ENTRIES = 40  # of a random array
_MESSAGES = "dtsa_msgs.msg"
_TYPES = {
    **{f"/swarm/{name.lower()}": (_MESSAGES, name) for name in
       ("Slot", "Transmission", "Frame", "Report", "Process", "Configuration")},
    "/swarm/slot_record": (_MESSAGES, "SlotRecord"),
    "/swarm/status": (_MESSAGES, "RunStatus"),
    "/cf1/odom": ("nav_msgs.msg", "Odometry"),
    "/clock": ("rosgraph_msgs.msg", "Clock"),
}  # fmt: skip
_JUNK = ("bytes", "default", "random")
_DROPPED = "dropped and counted; the flight goes on; the bag verifies"
_NOT_BELIEVED = "nobody in the flight believes it; the flight goes on; the bag verifies"


def _environment(flight: FlightProcess) -> dict[str, str]:
    known = flight.environment(flight.nodes[0])
    names = ("ROS_DOMAIN_ID", "ROS_AUTOMATIC_DISCOVERY_RANGE", "RMW_IMPLEMENTATION")
    return {**os.environ, **{name: known[name] for name in names if name in known}}


def _intrude(directory: Path, words: tuple[str, ...], topics: tuple[str, ...], kinds: tuple[str, ...]) -> None:
    """Let a foreign node publish on topics of a flight, see :func:`main`; the flight goes on and its bag verifies."""
    with start_flight(directory, *words, *ENDLESS) as flight:
        path = os.pathsep.join([str(Path(__file__).parents[1]), *sys.path])
        for topic in topics:
            sent = 0
            for kind in kinds:
                done = subprocess.run(
                    [sys.executable, "-m", __name__, topic, kind],
                    env={**_environment(flight), "PYTHONPATH": path},
                    capture_output=True, text=True, timeout=PATIENCE_S, check=False,
                )  # fmt: skip
                assert done.returncode == 0, done.stderr[-300:]
                sent += int(done.stdout)
            assert sent, f"nothing was published on {topic}"
            assert flight.process.poll() is None, f"after {topic}: {flight.stderr()[-300:]}"
        flight.assert_flies_on()
        flight.interrupt()


def _row(
    what: str, reaction: str, words: tuple[str, ...], topics: str, kinds: tuple[str, ...] = _JUNK, name: str = ""
) -> None:
    def run(directory: Path) -> None:
        _intrude(directory, words, tuple(topics.split()), kinds)

    name = name or f"junk_on_{topics.split()[0].strip('/').replace('/', '_')}"
    FAULTS.append(Fault(what, reaction, run, name + "_in_real_time" * (words == REALTIME), False))


_row("junk on `/swarm/transmission`, lockstep: bytes, empty and random messages", _DROPPED, LOCKSTEP,
     "/swarm/transmission")  # fmt: skip
_row("junk on `/swarm/slot`, lockstep", _DROPPED, LOCKSTEP, "/swarm/slot")
for _topic in ("transmission", "slot", "frame", "report"):
    _row(f"junk on `/swarm/{_topic}`, real time", _DROPPED, REALTIME, f"/swarm/{_topic}")
_row("junk on `/swarm/process`, by which nodes show each other what they fly with", _DROPPED, LOCKSTEP,
     "/swarm/process")  # fmt: skip
_row("junk on `/swarm/slot_record`, `/swarm/status`, `/swarm/configuration`", _NOT_BELIEVED,
     LOCKSTEP, "/swarm/slot_record /swarm/status /swarm/configuration", ("random",))  # fmt: skip
_row("junk on `/cf1/odom` and `/clock`", _NOT_BELIEVED, LOCKSTEP, "/cf1/odom /clock", ("random",))
_row("all answers and slot messages are published a second time, lockstep",
     "each counts once; the flight goes on; the bag verifies", LOCKSTEP, "/swarm/transmission /swarm/slot",
     ("again",), "duplicates")  # fmt: skip
_row("answers and slot messages with the id of another run, lockstep", _DROPPED, LOCKSTEP,
     "/swarm/transmission /swarm/slot", ("foreign",), "another_run")  # fmt: skip
_row("frames, reports and slot messages with the id of another run, real time", _DROPPED, REALTIME,
     "/swarm/frame /swarm/report /swarm/slot", ("foreign",), "another_run")  # fmt: skip


@fault("`replay` of a bag into the domain of a live flight", _DROPPED, sample=True)
def bag_replayed(directory: Path) -> None:
    done = run_dtsa("fly", "--out", str(directory / "old"), *LOCKSTEP, "--timeout-s", "1", "--no-picture")
    assert done.returncode == 0, done.stderr[-300:]
    with start_flight(directory / "live", *LOCKSTEP, *ENDLESS) as flight:
        replayed = subprocess.run(
            [sys.executable, "-m", "dtsa_bench", "replay", str(directory / "old")],
            env=_environment(flight), capture_output=True, text=True, timeout=PATIENCE_S, check=False,
        )  # fmt: skip
        assert replayed.returncode == 0, replayed.stderr[-300:]
        flight.assert_flies_on()
        flight.interrupt()


def random_message(kind: Any, pick: random.Random) -> Any:
    message = kind()
    for name, spec in kind.get_fields_and_field_types().items():
        setattr(message, name, _random_value(spec, getattr(message, name), pick))
    return message


def _random_value(spec: str, default: Any, pick: random.Random) -> Any:
    if spec.startswith("sequence<"):
        inner = spec[len("sequence<") : -1].partition(",")[0]
        values = [_random_number(inner, pick) for _ in range(pick.choice((0, 1, 2, pick.randrange(_MOST_ENTRIES))))]
        if inner == "string":
            return [str(value) for value in values]
        return array(default.typecode, values) if isinstance(default, array) else default
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
    bits = int("".join(letter for letter in spec if letter.isdigit()) or 8)
    unsigned = spec.startswith("u") or spec in ("octet", "char")
    low, high = (0, 2**bits - 1) if unsigned else (-(2 ** (bits - 1)), 2 ** (bits - 1) - 1)
    value = pick.choice((low, high, 0, 1, 2, 3, pick.randint(low, high)))
    return bytes([value]) if spec == "octet" else value


def main(topic: str, kind: str) -> None:
    """Publish on a topic for a few seconds, as a process in the flight's domain; print how many messages.

    Kinds: ``bytes`` (no message of the type), ``default`` (all fields empty), ``random`` (fields of random length and
    value), ``again`` (what it receives on the topic, once more), ``foreign`` (the same with the id of another run).
    """
    import rclpy
    from rclpy.qos import QoSProfile
    from rclpy.serialization import serialize_message

    from dtsa_agent.ros.common.cdr import RUN_BYTES

    module, name = _TYPES[topic]
    message_type = getattr(importlib.import_module(module), name)
    pick = random.Random(f"{topic} {kind}")
    rclpy.init()
    node = rclpy.create_node("intruder")
    publisher = node.create_publisher(message_type, topic, QoSProfile(depth=100))
    sent = 0

    def publish(data: bytes) -> None:
        nonlocal sent
        publisher.publish(data)
        sent += 1

    def receive(data: bytes) -> None:
        changed = bytearray(data)
        if kind == "foreign":
            changed[RUN_BYTES] = struct.pack("<I", pick.randrange(1, 2**32))
        publish(bytes(changed))

    if kind in ("again", "foreign"):
        node.create_subscription(message_type, topic, receive, QoSProfile(depth=100), raw=True)
    discovered_by = time.monotonic() + _DISCOVERY_S
    while not publisher.get_subscription_count() and time.monotonic() < discovered_by:
        time.sleep(_PAUSE_S)
    begun = time.monotonic()
    while time.monotonic() < begun + (_S if sent else _LONG_S) and sent < 2000:
        if kind == "bytes":
            publish(bytes([0, 1, 0, 0]) + pick.randbytes(pick.randrange(200)))
        elif kind == "default":
            publish(bytes(serialize_message(message_type())))
        elif kind == "random":
            publish(bytes(serialize_message(random_message(message_type, pick))))
        rclpy.spin_once(node, timeout_sec=_PAUSE_S)
    print(sent)
    rclpy.try_shutdown()


if __name__ == "__main__":
    main(*sys.argv[1:])
