"""Policy ``lease``: only whose turn it is gives it away. Rules, events and proof: docs/protocol.md.

* :mod:`.memory`: what an agent remembers, and what that says about a turn
* :mod:`.decide`: who sends in a slot
* :mod:`.listen`: what a frame changes, and what silence does
* :mod:`.issue`: which turns an agent gives away, and to whom
"""
