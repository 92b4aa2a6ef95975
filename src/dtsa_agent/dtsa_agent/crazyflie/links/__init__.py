"""The link to one Crazyflie, over a radio or UDP: all that talks to cflib."""
