"""Where a Crazyflie is: motion capture, and whether its own estimate can be believed. Pure."""
