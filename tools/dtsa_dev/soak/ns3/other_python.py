"""The other Python: one that has ns-3's wheel, which this project does not depend on."""

from __future__ import annotations

import json
import os
import subprocess
from pathlib import Path
from typing import Any

from dtsa_agent.core.errors import ConfigError, DtsaError

#: Environment variable that names it.
PYTHON = "DTSA_NS3_PYTHON"
#: The version whose figures the record holds.
WHEEL = "ns3==3.44.post0"
_THEIRS = Path(__file__).with_name("theirs.py")
_VERSION = "from importlib.metadata import version; print(version('ns3'))"
_LIMIT_S = 900.0


def check() -> None:
    """Looks whether there is one.

    :raises ConfigError: if there is none, saying what to install.
    """
    python = os.environ.get(PYTHON, "")
    try:
        subprocess.run([python, "-c", _VERSION], check=True, capture_output=True, timeout=60.0)
    except (OSError, subprocess.SubprocessError):
        allowed = f"a Python that has ns-3: python3 -m venv DIR && DIR/bin/pip install {WHEEL}, then DIR/bin/python"
        raise ConfigError(PYTHON, python, allowed) from None


def ask(question: dict[str, Any]) -> dict[str, Any]:
    """Lets ns-3 answer a question.

    :param question: see :mod:`.theirs`.
    :raises ConfigError: if there is no ns-3.
    :raises DtsaError: if it ends without an answer.
    """
    check()
    done = subprocess.run(
        [os.environ[PYTHON], str(_THEIRS)], input=json.dumps(question), capture_output=True, text=True, timeout=_LIMIT_S
    )
    if done.returncode:
        raise DtsaError(f"ns-3 ended with code {done.returncode}: {done.stderr.strip()[-300:]}")
    return dict(json.loads(done.stdout))
