"""Who enters: a scheme that comes with the package, an installed plug-in, or a folder or wheel with one."""

from __future__ import annotations

import hashlib
import importlib
import os
import re
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import dataclass
from importlib.metadata import Distribution, PackageNotFoundError, distribution, distributions
from pathlib import Path
from typing import Any

from dtsa_agent.core.errors import ConfigError
from dtsa_agent.core.registry import POLICIES
from dtsa_bench.experiments.batch.code import package_digest

from .cells import check_scheme, entrants

_NAME = re.compile(r"[a-z0-9][a-z0-9._-]{0,39}")
_LONGEST_INSTALL_S = 300
#: What metadata says of the licence, the most precise first.
_LICENSE, _AUTHOR = ("License-Expression", "License"), ("Author", "Author-email", "Maintainer", "Maintainer-email")


@dataclass(frozen=True, slots=True)
class Entrant:
    """A scheme that flies."""

    name: str  # of the entry
    scheme: Mapping[str, Any]  # what it sets: policy, that policy's settings, format of frames
    kind: str  # "scheme", or "bound": it looks into all agents, and no radio could tell it
    package: Mapping[str, Any]  # distribution, version, licence, author, digest


def entrant_of(what: str, name: str | None, policy: str | None, changes: Mapping[str, Any], room: Path) -> Entrant:
    """Who enters.

    :param what: name of an entrant of the package, of a policy, of an installed distribution, or a folder or wheel.
    :param name: of the entry; None: that of the entrant or policy.
    :param policy: which policy of a distribution that announces several.
    :param changes: settings of the scheme that win.
    :param room: directory into which a folder or wheel is installed.
    :raises ConfigError: if there is no such policy, or it cannot be used.
    """
    file: dict[str, Any] = {}
    if what in entrants():
        own = entrants()[what]
    elif what in POLICIES.rows or what in POLICIES.plug_in_names():
        own = {"policy": what}
    elif Path(what).exists():
        file = install(Path(what), room)
        found = next(iter(distributions(path=[str(room)])), None)
        own = {"policy": _policy_of(found, what, policy)}
    else:
        own = {"policy": _policy_of(_installed(what), what, policy)}
    scheme = {key: value for key, value in own.items() if key != "bound"} | dict(changes)
    check_scheme(scheme)
    chosen = name or (what if what in entrants() else str(scheme["policy"]))
    if not _NAME.fullmatch(chosen):
        raise ConfigError("name", chosen, "lower-case letters, digits, dots and hyphens, 40 at most")
    row = POLICIES.row(scheme["policy"])
    bound = own.get("bound", False) or (row.needs_everybody and what not in entrants())
    return Entrant(chosen, scheme, "bound" if bound else "scheme", {**package_of(scheme["policy"]), **file})


def _installed(what: str) -> Distribution:
    try:
        return distribution(what)
    except (PackageNotFoundError, ValueError):
        known = ", ".join((*entrants(), *sorted(POLICIES.plug_in_names() - entrants().keys())))
        allowed = f"{known}, an installed distribution, a folder with a pyproject.toml or a wheel"
        raise ConfigError("PACKAGE", what, allowed) from None


def _policy_of(found: Distribution | None, what: str, policy: str | None) -> str:
    """The policy that a distribution announces."""
    points = [] if found is None else found.entry_points
    names = sorted(point.name for point in points if point.group == POLICIES.group)
    if not names:
        raise ConfigError("PACKAGE", what, f"one that announces a policy in the group {POLICIES.group}")
    if policy is None and len(names) == 1:
        return names[0]
    if policy not in names:
        raise ConfigError("policy", policy, f"one of those that {what} announces: {', '.join(names)}")
    return str(policy)


def package_of(policy: str) -> dict[str, Any]:
    """What the metadata of a policy's distribution say; what they do not say is None.

    :param policy: name of the policy.
    """
    found = POLICIES.plug_ins()[policy].dist if policy not in POLICIES.rows else _own()
    metadata: Any = {} if found is None else found.metadata
    classified = (
        [line for line in (metadata.get_all("Classifier") or ()) if line.startswith("License ::")] if found else []
    )
    return {
        "distribution": metadata.get("Name") if found else None,
        "version": metadata.get("Version") if found else None,
        "license": _first(metadata, _LICENSE) or ("; ".join(classified) or None),
        "author": _first(metadata, _AUTHOR),
        "digest": package_digest("policy", policy),
    }


def _own() -> Distribution | None:
    """The distribution of what is built in: that of all packages, or that of the agent in a workspace."""
    with suppress(PackageNotFoundError):
        return distribution("dtsa")
    with suppress(PackageNotFoundError):
        return distribution("dtsa_agent")
    return None


def _first(metadata: Any, names: tuple[str, ...]) -> str | None:
    given = (metadata.get(name) for name in names)
    return next((" ".join(str(text).split()) for text in given if text and str(text) != "UNKNOWN"), None)


def install(source: Path, room: Path) -> dict[str, Any]:
    """Installs a folder or wheel into a directory that this process and its workers import from.

    :param source: a folder with a ``pyproject.toml``, or a wheel.
    :param room: the directory; made anew.
    :returns: name of a wheel, and its SHA-256.
    :raises ConfigError: if it cannot be installed.
    """
    wheel = source.suffix == ".whl" and source.is_file()
    if not wheel and not (source / "pyproject.toml").is_file():
        raise ConfigError("PACKAGE", str(source), "a folder with a pyproject.toml, or a wheel (.whl)")
    shutil.rmtree(room, ignore_errors=True)
    with tempfile.TemporaryDirectory() as directory:
        built = source
        if not wheel:  # a copy: building leaves files behind
            built = Path(directory) / "source"
            shutil.copytree(source, built, ignore=shutil.ignore_patterns(".git", "build", "dist", "*.egg-info"))
        command = [
            sys.executable,
            "-m",
            "pip",
            "install",
            "--quiet",
            "--no-deps",
            "--no-build-isolation",
            "--no-compile",
        ]
        command += ["--disable-pip-version-check", "--no-index", "--target", str(room), str(built)]
        done = subprocess.run(command, capture_output=True, text=True, timeout=_LONGEST_INSTALL_S, check=False)
    if done.returncode:
        lines = [line for line in done.stderr.splitlines() if line.strip()] or ["no reason given"]
        reason = next((line for line in reversed(lines) if "rror" in line), lines[-1]).strip()
        raise ConfigError("PACKAGE", str(source), f"a package that pip installs here ({reason})")
    sys.path.insert(0, str(room.resolve()))
    paths = [str(room.resolve()), os.environ.get("PYTHONPATH", "")]
    os.environ["PYTHONPATH"] = os.pathsep.join(path for path in paths if path)  # of worker processes
    importlib.invalidate_caches()
    if not wheel:
        return {}
    return {"wheel": source.name, "wheel_sha256": hashlib.sha256(source.read_bytes()).hexdigest()}
