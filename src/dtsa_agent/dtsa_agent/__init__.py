"""One quadcopter of a swarm that shares a radio channel."""
