"""The bridge as Crazyswarm2's programs know their server: imported only when asked for.

Node, services, topics, parameters and units are those of its crazyflie_server; the rules of the bridge stay in force.
"""
