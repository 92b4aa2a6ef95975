"""Recorded flights: bags, tables of them, agents' bags merged into one flight, and verification.

It imports `simulation`, `drawing` and `runs`.
"""
