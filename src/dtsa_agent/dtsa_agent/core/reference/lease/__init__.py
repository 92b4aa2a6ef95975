"""Policy ``lease``: only the owner of a turn gives it away.

Rules and events: docs/reference/protocol.md; proof: docs/explanation/policies.md.

* :mod:`.memory`: what an agent remembers, and what that says about a turn
* :mod:`.decide`: who sends in a slot
* :mod:`.listen`: what a frame changes, and what silence does
* :mod:`.issue`: which turns an agent gives away, and to whom
"""
