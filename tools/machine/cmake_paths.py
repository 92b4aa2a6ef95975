"""Mends the CMake files that the ROS wheels bring along.

The wheels export the include directories of the machine that built them (Python's and NumPy's). CMake refuses
an imported target whose include directory does not exist, so these paths are rewritten once to this
environment's own.
"""

from __future__ import annotations

import os
import re
from pathlib import Path

PYTHON_INCLUDE = re.compile(r'[^"\s;]+/include/python3\.\d+(?=["\s;])')
NUMPY_INCLUDE = re.compile(r'[^"\s;]+/numpy/(?:_core|core)/include(?=["\s;])')


def mend(share: Path, python_include: str, numpy_include: str) -> int:
    """Rewrite include directories that do not exist here.

    :param share: `share` directory of the environment with the ROS wheels.
    :param python_include: directory of this interpreter's `Python.h`.
    :param numpy_include: directory of this environment's NumPy headers.
    :returns: number of files that were changed.
    """

    def here(path: str) -> str:
        return path if "${" in path or os.path.isdir(path) else ""

    changed = 0
    for file in sorted(share.glob("*/cmake/*.cmake")):
        text = file.read_text(encoding="utf-8")
        mended = PYTHON_INCLUDE.sub(lambda match: here(match[0]) or python_include, text)
        mended = NUMPY_INCLUDE.sub(lambda match: here(match[0]) or numpy_include, mended)
        if mended != text:
            temporary = file.with_suffix(".cmake.new")
            temporary.write_text(mended, encoding="utf-8")
            os.replace(temporary, file)
            changed += 1
    return changed
