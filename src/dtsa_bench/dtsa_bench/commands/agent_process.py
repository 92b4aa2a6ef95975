"""The program of a process that has become an agent on a network: `tools/dtsa agent` after its options are read."""

from __future__ import annotations

import os
import pickle
import sys

from dtsa_bench.network.flying import fly


def main() -> int:
    """Flies; the first word is the file descriptor of the order."""
    try:
        with os.fdopen(int(sys.argv[1]), "rb") as file:
            order = pickle.load(file)  # of this very process, before it became this one
        return fly(order)
    except KeyboardInterrupt:
        return 130
    except Exception as error:
        from .cli import report

        return report(error)


if __name__ == "__main__":
    sys.exit(main())
