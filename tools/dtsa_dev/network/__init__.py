"""Computers for trials of agents on a network: network namespaces, switches between them, and strangers."""
