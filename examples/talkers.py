"""Two robots that talk, for `tools/dtsa relay examples/relay.yaml`: each prints what it receives of the other.

Run it by `tools/dtsa shell -c "python examples/talkers.py"`. Ctrl-C ends it.
"""

import contextlib

import rclpy
from rclpy.executors import ExternalShutdownException
from std_msgs.msg import String

ROBOTS = ("robot1", "robot2")


def main() -> None:
    rclpy.init()
    node = rclpy.create_node("talkers")
    publishers = {robot: node.create_publisher(String, f"/{robot}/chatter", 10) for robot in ROBOTS}
    count = 0

    def send() -> None:
        nonlocal count
        count += 1
        for publisher in publishers.values():
            publisher.publish(String(data=f"message {count}"))

    for robot, other in (ROBOTS, ROBOTS[::-1]):
        topic = f"/{robot}/from/{other}/chatter"
        node.create_subscription(String, topic, lambda message, topic=topic: print(topic, message.data, flush=True), 10)
    node.create_timer(0.5, send)
    with contextlib.suppress(KeyboardInterrupt, ExternalShutdownException):
        rclpy.spin(node)


if __name__ == "__main__":
    main()
