"""How flights and figures look: colours, style, and the picture of a flight's paths. It imports `runs`."""

from __future__ import annotations

import sys
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path


@contextmanager
def optional_picture(file: Path) -> Iterator[Path]:
    """Draw a picture that nothing depends on: whatever fails, its import included, is one line on standard error.

    Gives the file to draw into, which takes the place of `file` once it is whole.
    """
    part = file.with_suffix(f".part{file.suffix}")
    try:
        yield part
        part.replace(file)
    except Exception as error:
        text = " ".join(str(error).split())[:300] or type(error).__name__
        print(f"dtsa: warning: no {file.name}: {text}", file=sys.stderr)
    finally:
        with suppress(OSError):
            part.unlink(missing_ok=True)
