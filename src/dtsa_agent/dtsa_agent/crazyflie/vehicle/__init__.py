"""One Crazyflie as the bridge knows it: its link, its state, its orders, its way down."""
