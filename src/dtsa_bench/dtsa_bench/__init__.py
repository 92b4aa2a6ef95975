"""Flights, experiments and their analysis."""
