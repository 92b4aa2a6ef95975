"""`python -m dtsa_bench COMMAND ...`: see :mod:`dtsa_bench.cli`."""

import sys

from dtsa_bench.entry import dtsa

sys.exit(dtsa())
