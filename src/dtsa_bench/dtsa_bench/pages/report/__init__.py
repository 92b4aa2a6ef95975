"""The report: one self-contained HTML page of one recorded run, or of several side by side.

`data` computes what the page shows, and writes it. `tables` writes the pages of sweeps and leagues.
"""
