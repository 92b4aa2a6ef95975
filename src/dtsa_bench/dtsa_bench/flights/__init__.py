"""Flights with real nodes: starts the channel and the agents, watches over them, ends them all.

It imports `log`, `simulation` and `runs`.
"""
