"""Python's headers of this machine for another processor: whether the sizes that they state hold there, too."""

from __future__ import annotations

import re
import sysconfig
from pathlib import Path

_TYPES = {
    "DOUBLE": "double", "FLOAT": "float", "INT": "int", "LONG": "long", "LONG_LONG": "long long", "SHORT": "short",
    "VOID_P": "void *", "SIZE_T": "size_t", "WCHAR_T": "wchar_t", "UINTPTR_T": "uintptr_t", "OFF_T": "off_t",
    "PID_T": "pid_t", "TIME_T": "time_t", "LONG_DOUBLE": "long double", "_BOOL": "_Bool", "FPOS_T": "fpos_t",
}  # fmt: skip


def include() -> str:
    """The directory of the headers that an extension is compiled with."""
    return sysconfig.get_path("include")


def check_source() -> str:
    """A C source that compiles only where every size in pyconfig.h is the true one.

    The stable ABI leaves nothing else of pyconfig.h that could differ between two 64-bit Linux systems.
    """
    text = Path(sysconfig.get_config_h_filename()).read_text(encoding="utf-8")
    lines = ["#define Py_LIMITED_API 0x030A0000", "#include <Python.h>", "#include <wchar.h>", "#include <time.h>"]
    for name, size in re.findall(r"^#define SIZEOF_(\w+) (\d+)$", text, re.MULTILINE):
        if name in _TYPES:
            lines.append(f'_Static_assert(sizeof({_TYPES[name]}) == {size}, "SIZEOF_{name}");')
    return "\n".join([*lines, ""])
