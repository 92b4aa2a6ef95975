"""The report of runs: `data` computes what the page shows, and writes it; `tables`: pages of sweeps and leagues."""
