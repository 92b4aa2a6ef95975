"""The bags of agents on a network as one flight: on one time line, flown again, and judged."""
