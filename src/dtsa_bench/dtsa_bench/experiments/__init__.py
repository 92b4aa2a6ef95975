"""Many simulated flights: sweeps over settings, batches on all cores or a cluster, statistics, figures.

It imports `simulation`, `drawing` and `runs`.
"""
