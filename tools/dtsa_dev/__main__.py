"""`python -m dtsa_dev COMMAND ...`: the commands of `dtsa_bench`, and those that only a checkout has."""

import sys

from dtsa_bench.__main__ import dtsa

from .registry import add_commands

add_commands()
sys.exit(dtsa())
