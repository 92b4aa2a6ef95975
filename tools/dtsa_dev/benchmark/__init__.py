"""How fast everything is on this machine, beside other implementations of the same, in one run."""
