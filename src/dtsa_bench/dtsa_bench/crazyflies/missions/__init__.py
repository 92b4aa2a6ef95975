"""Missions with Crazyflies: their ground station, their places, and the record."""
