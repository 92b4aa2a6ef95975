"""Crazyflies: simulated vehicles and radios, and missions with simulated or real ones.

It imports `pages`, `flights` and what lies below.
"""
