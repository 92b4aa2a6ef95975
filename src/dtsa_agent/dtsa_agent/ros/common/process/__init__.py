"""The life of a node's process: start, loop, priority, peers, waiting, end."""
