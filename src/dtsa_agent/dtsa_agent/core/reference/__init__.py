"""The protocol as a specification that runs: plain Python, to be read beside the paper and docs/reference/protocol.md.

Everything that agents must agree on stands here once, and once more in C (``libdtsa``), which is what flies. Both
give the same frames, tables, decisions, digests and times, bit for bit; tests hold them together.
The page's section "From a rule to the code" leads from an equation to both.

Throughout, ``slot`` is the number of a slot, ``self_index`` and ``k`` are ids - 1, ``step`` is a control instant within
a slot, ``rules`` is what all agree on, ``memory`` and ``table`` are those of the agent that acts. Positions are m,
velocities m/s, frame map; times ns of the agent's own clock.

Nothing that is installed imports it; tests and ``dtsa_dev`` do. One file, one subject:

* :mod:`.arithmetic`: what the bits of a result depend on, and why
* :mod:`.rules`: the settings that all agents share
* :mod:`.frame`, :mod:`.frame_extended`: what is on the air, and whose it was
* :mod:`.table`, :mod:`.gossip`: what an agent knows of the others
* :mod:`.estimators`: where the others are by now
* :mod:`.policies`: who sends, by priorities and counters
* :mod:`.lease`: the policy that needs no equal tables
* :mod:`.agent`: one agent in a slot
* :mod:`.station`: an agent with a clock of its own

It needs no NumPy, but for :mod:`.stepper`, which makes a swarm of it for flights beside the compiled one.
"""
