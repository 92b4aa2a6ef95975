"""Agents on a real network: their flight and its record, and a listener that judges what is on the air."""
