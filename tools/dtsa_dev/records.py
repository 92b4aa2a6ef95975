"""Records of what was measured, for ``docs/evidence``: small JSON files, of which pages make their tables."""

from __future__ import annotations

import hashlib
import json
import os
import platform
import sys
import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

_ROOT = Path(__file__).resolve().parents[2]
EVIDENCE = _ROOT / "docs" / "evidence"


def write_record(
    path: Path, command: str, heads: Sequence[str], rows: Sequence[Sequence[object]], figures: Mapping[str, Any]
) -> None:
    """Write the record of a measurement, a row of its table a line; `command`, without `tools/dtsa`, makes it again."""
    import numpy as np

    record = {
        "command": command,
        "date": time.strftime("%Y-%m-%d", time.gmtime()),
        "versions": f"Python {platform.python_version()}, NumPy {np.__version__}, {platform.system()}",
        "cores": len(os.sched_getaffinity(0)),
        "code": code_digest(),
        **figures,
        "heads": list(heads),
    }
    lines = [f" {json.dumps(key)}: {json.dumps(value, ensure_ascii=False)}," for key, value in record.items()]
    body = ",\n".join(f"  {json.dumps(list(row), ensure_ascii=False)}" for row in rows)
    text = "\n".join(["{", *lines, ' "rows": [', *([body] if body else []), " ]", "}", ""])
    assert len(text.splitlines()) <= 60, f"{path}: a record has 60 lines at most"
    path.write_text(text, encoding="utf-8")
    print(f"record: {path}", file=sys.stderr)


def code_digest() -> str:
    """A digest of the sources, without tests, of packages and developers' tools."""
    digest = hashlib.sha256()
    for place in (_ROOT / "src", _ROOT / "tools" / "dtsa_dev"):
        for path in sorted(place.rglob("*")):
            name = path.relative_to(_ROOT)
            if path.suffix in (".py", ".c", ".h", ".msg", ".srv") and not {"test", "build"} & set(name.parts):
                digest.update(str(name).encode() + b"\0" + path.read_bytes() + b"\0")
    return digest.hexdigest()[:16]


def read_record(name: str) -> dict[str, Any]:
    """A record."""
    record: dict[str, Any] = json.loads((EVIDENCE / f"{name}.json").read_text(encoding="utf-8"))
    return record


def load() -> float:
    """Load of the machine over the last minute."""
    return round(os.getloadavg()[0], 1)
