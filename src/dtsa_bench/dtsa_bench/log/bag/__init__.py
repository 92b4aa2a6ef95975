"""Bags: runs recorded to MCAP the way rosbag2 does it.

`writer` records, `reader` reads back (without ROS), `recover` saves what a killed writer left, `replay` publishes it
again. `file` is one file of a bag, whole or not; `schema` and `metadata` hold what rosbag2 wants to find in a bag;
`cdr` packs the messages of viewers.
"""
