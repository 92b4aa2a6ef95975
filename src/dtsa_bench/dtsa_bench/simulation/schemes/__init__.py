"""Schemes of the literature, and bounds, as plug-ins beside the built-in policies.

docs/reference/schemes.md describes each.

Each is announced by entry point in the group ``dtsa.policies``, so ``--policy genie-age`` works in `simulate` and
`sweep`, and in nodes where its kind allows it.
"""
