"""Missions with Crazyflies: their ground station, the way to their places, the record, and a rehearsal."""
