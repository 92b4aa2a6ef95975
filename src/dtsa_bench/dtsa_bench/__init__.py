"""Flights, experiments and their analysis."""

__version__ = "0.2.0"  # the project's; a test compares it with those of all packages
