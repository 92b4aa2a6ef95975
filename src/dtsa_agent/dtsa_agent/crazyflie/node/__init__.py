"""The bridge to all Crazyflies of a swarm, as a node on the graph."""
