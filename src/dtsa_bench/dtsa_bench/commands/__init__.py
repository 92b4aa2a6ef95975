"""The commands of `tools/dtsa`, one module each: `add_parser(subparsers)` and `run(args) -> int`."""
