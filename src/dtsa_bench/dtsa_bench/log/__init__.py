"""What happened in a flight: the log, how it is recorded, read, replayed, verified, joined and exported.

It imports `simulation`, `drawing` and `runs`.
"""
