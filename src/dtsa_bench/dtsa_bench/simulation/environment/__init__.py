"""Flights whose agents send as somebody else says: an environment for learning (docs/how-to/learning.md).

`batch` flies many at once on arrays, `parallel` one of them as a `ParallelEnv` of PettingZoo.
"""
