"""A simulated radio: Crazyradio dongles below pyusb, simulated Crazyflies on the air."""
