"""`dtsa release`: the distribution, made and tried."""

from __future__ import annotations

import argparse

DESCRIPTION = """\
Makes the source distribution and the wheels (x86_64 and aarch64) of this checkout, installs each in fresh environments
of Python 3.10 to 3.13 (aarch64: Debian's Python in QEMU), tries every command there, compares the digests of flights,
and checks metadata, sizes and times. The files, release.json and release.log are then in DIR. Nothing is uploaded."""
EXAMPLES = (
    ("--out dist", "everything"),
    ("--out dist --skip 3.12 --skip aarch64", "on a machine without that Python and without a cross compiler"),
)


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Adds the command's options."""
    from dtsa_dev.release.parts import PARTS

    parser.add_argument("--out", metavar="DIR", required=True, help="new directory for the files")
    parser.add_argument(
        "--skip",
        metavar="NAME",
        action="append",
        default=[],
        help=f"do without, where the machine lacks what it needs: {', '.join(PARTS)}; more than once",
    )
    parser.add_argument(
        "--aarch64-root",
        metavar="DIR",
        help="where Debian's Python for aarch64 is unpacked, and kept [fetched each time, not kept]",
    )
    parser.add_argument("--json", action="store_true", help="print release.json instead of tables")


def run(args: argparse.Namespace) -> int:
    """Make and try."""
    from dtsa_dev.release.release import release

    return release(args.out, set(args.skip), args.aarch64_root, args.json)
