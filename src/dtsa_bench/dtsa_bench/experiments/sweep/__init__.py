"""Many simulated flights over a grid of settings:

planned, flown on all cores or a cluster, summed up, reported.
"""
