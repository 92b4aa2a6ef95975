"""Live agents: `driver` runs one over a port (`udp_port`, `serial_port`, `crazyradio_port`), which `port` describes."""
