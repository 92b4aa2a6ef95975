"""Names on the graph, namespaces and parameters: the same for all nodes of a swarm."""
