"""Policy ``lease``: only the owner of a turn gives it away. Rules: docs/reference/protocol.md."""
