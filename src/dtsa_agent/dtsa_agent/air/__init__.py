"""An agent with a clock of its own (`agent`: its loop), and the ports through which frames get on an air.

`port` says what is asked of a port. `udp` is the port of a network. Nothing here imports a port: the program that
starts an agent makes one and hands it over.
"""
