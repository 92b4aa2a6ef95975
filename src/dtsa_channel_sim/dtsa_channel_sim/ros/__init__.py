"""The channel as a ROS 2 node, in lockstep and in real time."""
