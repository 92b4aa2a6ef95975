"""Tools that only developers of this project run: soaks, proofs, experiments with the protocol alone, benchmarks."""
