"""Pages for a browser: reports of runs and sweeps, the live view, and the demo.

It imports `flights`, `experiments`, `recordings` and what lies below.
"""
