"""The protocol as a specification that runs: plain Python, to be read beside the paper and docs/reference/protocol.md.

Everything that agents must agree on stands here once, and once more in C (``libdtsa``), which is what flies. Both
give the same frames, tables, decisions, digests and times, bit for bit; tests hold them together.
docs/reference/equations.md leads from an equation to both.

Nothing in here needs NumPy, a compiler or the rest of the core. One file, one subject:

* :mod:`.arithmetic`: what the bits of a result depend on, and why
* :mod:`.rules`: the settings that all agents share
* :mod:`.frame`, :mod:`.frame_extended`: what is on the air
* :mod:`.table`, :mod:`.gossip`: what an agent knows of the others
* :mod:`.estimators`: where the others are by now
* :mod:`.priority`, :mod:`.selection`, :mod:`.policies`: who sends
* :mod:`.lease`: the policy that needs no equal tables
* :mod:`.agent`: one agent in a slot
* :mod:`.avoiders`, :mod:`.soft_problem`, :mod:`.vehicle`: where it flies
* :mod:`.alignment`, :mod:`.timebase`, :mod:`.tag`: which slot it is, and whose frame it was

``core.reference_swarm`` makes a swarm of it that `simulate --core reference` flies.
"""
