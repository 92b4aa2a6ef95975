"""`python -m dtsa_bench COMMAND ...`: see :mod:`dtsa_bench.commands.cli`."""

import sys

from .entry import dtsa

sys.exit(dtsa())
