"""Losses that were measured: who heard whom in a recorded flight, and the chains that this fits."""
