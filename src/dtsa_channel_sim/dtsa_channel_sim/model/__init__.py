"""The medium and the channel as pure code: no ROS, no clock, no I/O."""
