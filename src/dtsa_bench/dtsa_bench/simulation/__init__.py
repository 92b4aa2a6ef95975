"""Flights without ROS, as fast as the machine allows, and the schemes of the league.

It imports `runs`.
"""
