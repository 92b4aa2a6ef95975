"""What all nodes share: names on the graph, wire format, loop, parameters, the life of a process."""
