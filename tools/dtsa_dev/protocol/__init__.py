"""Experiments with the slot protocols alone: who sends when, ages, what faults do. No flight."""
