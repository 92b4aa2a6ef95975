"""Agents in slots as arrays: moved by the compiled core, or by the specification."""
