"""Pages for a browser: reports of runs and sweeps, the live view, and the demo."""
