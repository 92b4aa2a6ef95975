"""The bridge to real Crazyflies through cflib.

Everything here but `drivers`, `link` and `node` is plain Python without ROS and without cflib: configuration, unit
conversions, radio budget, state machine and safety rules can be used and tested by themselves.
"""
