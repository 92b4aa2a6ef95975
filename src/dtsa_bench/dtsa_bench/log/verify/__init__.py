"""Verification: field by field, what a recorded flight holds is compared with what replayed agents give."""
