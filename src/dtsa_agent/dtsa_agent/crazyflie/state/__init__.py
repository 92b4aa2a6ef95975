"""What is said of a Crazyflie: values with units and frames, and the states that it goes through."""
