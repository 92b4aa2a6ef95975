"""The ROS 2 nodes around the protocol core."""
