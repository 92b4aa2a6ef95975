"""The protocol as a specification that runs: plain Python, to be read beside the paper and docs/reference/protocol.md.

Everything that agents must agree on stands here once, and once more in C (``libdtsa``), which is what flies. Both
give the same frames, tables, decisions, digests and times, bit for bit; tests hold them together.
The page's section "From a rule to the code" leads from an equation to both. Only tests and ``dtsa_dev`` import it.

Throughout, ``slot`` is the number of a slot, ``k`` and ``me`` are ids - 1, ``step`` is a control instant within a slot,
``rules`` is what all agree on, ``memory`` and ``table`` are those of the agent that acts. Positions are m, velocities
m/s, frame map; times ns of the agent's own clock.
"""
