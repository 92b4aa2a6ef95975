"""Crazyflies: simulated vehicles and radios, and missions with simulated or real ones."""
