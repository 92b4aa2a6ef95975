"""What works around Fast DDS and rclpy.

Each file says under "Upstream" where the defect is known, and under "Delete when" when it can go. What works around
other packages stands where that package is used alone, and says the same: cflib in `crazyflie/links`, mcap in
`dtsa_bench.log.bag`.
"""
