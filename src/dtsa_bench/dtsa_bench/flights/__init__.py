"""Flights with real nodes: starts the channel and the agents, watches over them, ends them all."""
