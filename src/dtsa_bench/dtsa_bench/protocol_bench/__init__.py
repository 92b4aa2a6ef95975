"""Experiments with the slot protocols alone: who sends when, how old news is, what faults do. No flight."""
