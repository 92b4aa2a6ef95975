"""Pages for a browser: reports of runs and sweeps, the live view, and the demo.

It imports `flights`, `experiments`, `log` and what lies below.
"""
