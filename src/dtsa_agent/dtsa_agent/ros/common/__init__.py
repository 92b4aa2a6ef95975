"""The same for all nodes of a swarm: names, parameters, messages and their checks, and the life of a process."""
