"""Runs: their settings, their figures of merit, and both as text.

Every kind of run shares this: simulated, with nodes, merged from agents' bags. It imports nothing else of the bench.
"""
