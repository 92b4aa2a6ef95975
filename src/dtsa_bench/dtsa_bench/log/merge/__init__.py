"""The bags of agents on a network as one flight: put on one time line, and together to one log."""
