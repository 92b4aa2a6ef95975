"""The command line: one module a command, with `add_parser(subparsers)` and `run(args) -> int`, and what they share.

It imports everything; nothing imports it but the package's entry.
"""
