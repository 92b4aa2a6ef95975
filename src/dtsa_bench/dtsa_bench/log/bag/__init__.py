"""Bags: runs recorded to MCAP the way rosbag2 does it.

`writer` records, `reader` reads back (without ROS), `recover` saves what a killed writer left, `replay` publishes it
again. `schema` and `metadata` hold what rosbag2 wants to find in a bag, `cdr` packs the messages of viewers.
"""
