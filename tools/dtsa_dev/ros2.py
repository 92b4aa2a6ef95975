"""A small `ros2` command, for machines with the wheels of ROS only: what a user of this workspace needs first."""

from __future__ import annotations

import importlib
import sys
import time
from collections.abc import Callable
from importlib.metadata import entry_points
from pathlib import Path
from typing import Any

import yaml

DISCOVERY_S = 1.0
ANSWER_S = 5.0
USAGE = """a small stand-in for the ros2 command:
  run PACKAGE EXECUTABLE [ARGUMENTS]     pkg executables             interface show PACKAGE/msg/NAME
  node list     topic list     topic echo TOPIC [--once]     topic hz TOPIC     bag info PATH
  param list NODE     param get NODE NAME     param set NODE NAME VALUE
  service list     service call SERVICE TYPE [YAML]"""


def main(words: list[str]) -> int:
    """Run one command.

    :returns: exit code.
    """
    nodes = {tuple(point.name.split(".", 1)): point for point in entry_points(group="dtsa.nodes")}
    try:
        match words:
            case ["-h" | "--help"]:
                print(USAGE)
            case ["run", package, executable, *rest] if (package, executable) in nodes:
                sys.argv = [executable, *rest]
                return int(nodes[package, executable].load()() or 0)
            case ["run", package, executable, *_]:
                raise LookupError(f"run: there is no {package} {executable} here; see `ros2 pkg executables`")
            case ["pkg", "executables"]:
                print("\n".join(sorted(" ".join(name) for name in nodes)))
            case ["interface", "show", name]:
                print(definition(name).read_text(encoding="utf-8"), end="")
            case ["bag", "info", path]:
                from rosbags.highlevel import AnyReader

                with AnyReader([Path(path)]) as reader:
                    print(f"duration: {reader.duration / 1e9:.3f} s\nmessages: {reader.message_count}")
                    print(
                        "\n".join(f"  {name} [{t.msgtype}]: {t.msgcount}" for name, t in sorted(reader.topics.items()))
                    )
            case [("node" | "topic" | "param" | "service"), _, *_]:
                return on_graph(words)
            case _:
                return refuse()
    except (LookupError, ValueError, OSError, ImportError, yaml.MarkedYAMLError) as error:
        print(f"ros2: error: {' '.join(str(error).split())}", file=sys.stderr)
        return 2
    except KeyboardInterrupt:
        return 130
    return 0


def refuse() -> int:
    """Say what there is."""
    print(USAGE, file=sys.stderr)
    return 2


def definition(name: str) -> Path:
    """File of an interface, `package/msg/Name`."""
    from ament_index_python.packages import get_package_prefix

    package, _, name_in_package = name.partition("/")
    return Path(get_package_prefix(package), "share", package, f"{name_in_package}.{name_in_package.partition('/')[0]}")


def class_of(name: str) -> Any:
    """Class of an interface, `package/msg/Name`."""
    try:
        package, kind, short = name.split("/")
        return getattr(importlib.import_module(f"{package}.{kind}"), short)
    except (ValueError, ImportError, AttributeError):
        raise LookupError(f"interface: got {name!r}; allowed: one that is installed, as std_msgs/msg/String") from None


def on_graph(words: list[str]) -> int:
    """Run a command that needs a node."""
    import rclpy
    from rclpy.parameter import get_parameter_value, parameter_value_to_python

    rclpy.init(args=[])
    node = rclpy.create_node(f"ros2_{time.time_ns()}", start_parameter_services=False)
    try:
        if words[1:] == ["list"]:
            discover(node)
        match words:
            case ["node", "list"]:
                names = {f"{space.rstrip('/')}/{name}" for name, space in node.get_node_names_and_namespaces()}
                print("\n".join(sorted(names - {node.get_fully_qualified_name()})))
            case ["topic", "list"]:
                print("\n".join(name for name, _ in node.get_topic_names_and_types()))
            case ["service", "list"]:
                print("\n".join(name for name, _ in node.get_service_names_and_types()))
            case ["topic", "echo", topic, *once] if once in ([], ["--once"]):
                listen(node, topic, lambda message, _: print(as_yaml(message), "---", sep="", flush=True), bool(once))
            case ["topic", "hz", topic]:
                listen(node, topic, lambda _, rate: print(f"average rate: {rate:.3f}", flush=True) if rate else None)
            case ["service", "call", service, kind, *request]:
                print(as_yaml(call(node, service, kind, yaml.safe_load(" ".join(request)) or {})), end="")
            case ["param", "list", name]:
                answer = call(node, f"{name}/list_parameters", "rcl_interfaces/srv/ListParameters", {})
                print("\n".join(sorted(answer.result.names)))
            case ["param", "get", name, parameter]:
                answer = call(
                    node, f"{name}/get_parameters", "rcl_interfaces/srv/GetParameters", {"names": [parameter]}
                )
                if not answer.values or not answer.values[0].type:
                    raise LookupError(f"param: got {parameter!r}; {name} has no such parameter")
                print(parameter_value_to_python(answer.values[0]))
            case ["param", "set", name, parameter, value]:
                one = class_of("rcl_interfaces/msg/Parameter")(name=parameter, value=get_parameter_value(value))
                request = {"parameters": [one]}
                answer = call(node, f"{name}/set_parameters", "rcl_interfaces/srv/SetParameters", request).results[0]
                if not answer.successful:
                    raise ValueError(f"param {parameter}: got {value!r}; refused: {answer.reason}")
                print("done")
            case _:
                return refuse()
    except Exception:
        if rclpy.ok():
            raise
        return 130  # a signal has ended the context
    finally:
        node.destroy_node()
        rclpy.try_shutdown()
    return 0


def discover(node: Any) -> None:
    """Wait until the graph has others in it and stays as it is for a while, at most as long as for an answer."""
    found, since, deadline = [], time.monotonic(), time.monotonic() + ANSWER_S
    while (now := time.monotonic()) < min(since + DISCOVERY_S, deadline):
        names = [*node.get_node_names_and_namespaces(), *node.get_topic_names_and_types()]
        if names != found or len(node.get_node_names()) == 1:
            found, since = names, now
        time.sleep(0.1)


def listen(node: Any, topic: str, receive: Callable[[Any, float], None], once: bool = False) -> None:
    """Give the messages on a topic to a function, with their rate each second, else 0."""
    import rclpy
    from rclpy.qos import QoSProfile

    deadline = time.monotonic() + ANSWER_S
    while not (publishers := node.get_publishers_info_by_topic(topic)) and time.monotonic() < deadline:
        time.sleep(0.1)
    if not publishers:
        raise LookupError(f"topic: got {topic!r}; no node sends on it")
    times: list[float] = []

    def on_message(message: Any) -> None:
        times.append(time.monotonic())
        rate = (len(times) - 1) / (times[-1] - times[0]) if times[-1] - times[0] >= 1.0 else 0.0
        times[:] = times[-1:] if rate else times
        receive(message, rate)

    theirs = publishers[0].qos_profile
    profile = QoSProfile(depth=10, reliability=theirs.reliability, durability=theirs.durability)
    node.create_subscription(class_of(publishers[0].topic_type), topic, on_message, profile)
    while not (once and times):
        rclpy.spin_once(node)


def call(node: Any, service: str, kind: str, fields: dict[str, Any]) -> Any:
    """Answer of a service.

    :raises ValueError: for a field that the request does not have, or a value that a field does not take.
    """
    import rclpy

    client = node.create_client(class_of(kind), service)
    if not client.wait_for_service(ANSWER_S):
        raise LookupError(f"service: got {service!r}; no node offers it")
    try:
        future = client.call_async(fill(class_of(kind).Request(), fields))
    except (AttributeError, AssertionError, TypeError) as error:
        raise ValueError(f"request: {error}") from None
    rclpy.spin_until_future_complete(node, future, timeout_sec=ANSWER_S)
    if not future.done():
        raise LookupError(f"service {service}: no answer within {ANSWER_S:.0f} s")
    return future.result()


def fill(message: Any, fields: dict[str, Any]) -> Any:
    """Set fields of a message."""
    for name, value in fields.items():
        setattr(message, name, fill(getattr(message, name), value) if isinstance(value, dict) else value)
    return message


def as_yaml(message: Any) -> str:
    """A message as YAML."""

    def plain(value: Any) -> Any:
        if hasattr(value, "get_fields_and_field_types"):
            return {name: plain(getattr(value, name)) for name in value.get_fields_and_field_types()}
        if hasattr(value, "tolist"):  # numbers of NumPy, and arrays of numbers
            return value.tolist()
        return value if isinstance(value, bytes | str | int | float) else [plain(each) for each in value]

    return yaml.safe_dump(plain(message), sort_keys=False)


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
