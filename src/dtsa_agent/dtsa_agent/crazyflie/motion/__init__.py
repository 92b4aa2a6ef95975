"""What a Crazyflie is told to fly: commands, paths, trajectories, and their limits."""
