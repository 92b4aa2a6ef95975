"""Flights over a network, of which every agent has a bag of its own: recorded, merged on one time line, judged."""
