"""What is frozen of a league: its cells, how seeds are derived, and what a flight is worth."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

from dtsa_agent.core.errors import ConfigError
from dtsa_agent.core.registry import POLICIES
from dtsa_agent.yaml_file import read_yaml
from dtsa_bench.experiments.sweep.spec import run_config

_HERE = Path(__file__).resolve().parent
PRACTICE, JUDGED = SEEDS = ("practice", "judged")
#: What an entry may set: its policy, that policy's own settings, the format of its frames.
SCHEME_SETTINGS = (
    "policy", "frame", "options", "gossip", "epsilon", "selection", "boot_round", "age_cap", "return_every",
    "anchor_every", "anchor_rest", "open_every", "adoption", "depth_rate", "lease_share",
)  # fmt: skip
_SHORTEST = "shortest"
_STEP_NS = 10_000  # of shortest slots


@dataclass(frozen=True, slots=True)
class LeagueCell:
    """One of the swarms and channels that every entry flies."""

    name: str
    text: str
    settings: Mapping[str, Any]  # flat names -> values, those of all cells included
    lost_age_ms: float  # counts as the age of a lost flight, and is the largest that counts of any other


@dataclass(frozen=True, slots=True, eq=False)
class League:
    """A league as its file says it."""

    name: str
    title: str
    release: str
    count: int  # seeds of a cell
    practice: str  # word of the practice seeds
    commitment: str  # SHA-256 of the word of the judged seeds
    cells: tuple[LeagueCell, ...]
    guard_ns: int
    decide_ns: int
    golden: Mapping[str, Any]
    digest: str  # of all that is frozen

    def cell(self, name: str) -> LeagueCell:
        """A cell by its name.

        :param name: its name.
        :raises ConfigError: if there is none of that name.
        """
        for cell in self.cells:
            if cell.name == name:
                return cell
        raise ConfigError("cells", name, ", ".join(cell.name for cell in self.cells))

    def seed(self, word: str, cell: str, k: int) -> int:
        """Seed k of a cell: the first 31 bits of SHA-256("WORD/CELL/k").

        :param word: the practice word, or the secret.
        :param cell: its name.
        :param k: number of the seed, from 0.
        """
        return int.from_bytes(hashlib.sha256(f"{word}/{cell}/{k}".encode()).digest()[:4], "big") >> 1

    def settings(self, cell: LeagueCell, scheme: Mapping[str, Any], seed: int) -> dict[str, Any]:
        """The settings of a flight by flat names.

        :param cell: the cell.
        :param scheme: what the entry sets, see :data:`SCHEME_SETTINGS`.
        :param seed: seed of the flight.
        :raises ConfigError: if the policy cannot fly the cell.
        """
        settings = {**cell.settings, **scheme, "seed": seed}
        if settings["slot_ms"] == _SHORTEST:
            settings["slot_ms"] = self._shortest_ms(settings)
        return settings

    def _shortest_ms(self, settings: Mapping[str, Any]) -> float:
        """The shortest slot that holds the frames of a scheme on the cell's radio."""
        run = run_config({**settings, "slot_ms": 10})
        needs_frame = run.swarm.policy_row.needs_frame
        slot_ns = run.air.airtime.shortest_slot_ns(
            run.swarm.frame_length,
            guard_ns=self.guard_ns,
            decide_ns=self.decide_ns if needs_frame else 0,
            needs_frame=needs_frame,
        )
        return -(-slot_ns // _STEP_NS) * _STEP_NS / 1e6

    def check_secret(self, secret: str) -> None:
        """Whether a word is the one of the judged seeds.

        :param secret: the word.
        :raises ConfigError: if it is not.
        """
        if commitment_of(secret) != self.commitment:
            raise ConfigError("secret", secret, f"the word whose SHA-256 is {self.commitment}")

    def published(self) -> str | None:
        """The word of the judged seeds, once it has been published; None: not yet."""
        path = _HERE / f"{self.name}-secret.yaml"
        if not path.exists():
            return None
        word = str(read_yaml(path, "secret")["secret"])
        self.check_secret(word)
        return word


def commitment_of(secret: str) -> str:
    """What is printed before the judging: SHA-256 of the word, hexadecimal.

    :param secret: the word.
    """
    return hashlib.sha256(secret.encode()).hexdigest()


def read_secret(path: str) -> str:
    """The word in a file.

    :param path: the file: the word alone.
    :raises ConfigError: if it cannot be read.
    """
    try:
        return Path(path).read_text(encoding="utf-8").strip()
    except (OSError, UnicodeDecodeError) as error:
        raise ConfigError("secret", path, f"a text file that can be read ({error})") from error


@cache
def league(name: str = "league-1") -> League:
    """A league that comes with the package.

    :param name: its name.
    """
    content = read_yaml(_HERE / f"{name}.yaml", "league")
    frozen = json.dumps({key: value for key, value in content.items() if key != "golden"}, sort_keys=True)
    cells = tuple(
        LeagueCell(key, cell["text"], {**content["base"], **cell["settings"]}, float(cell["lost_age_ms"]))
        for key, cell in content["cells"].items()
    )
    seeds, shortest = content["seeds"], content["shortest"]
    return League(
        content["name"],
        content["title"],
        content["release"],
        seeds["count"],
        seeds["practice"],
        seeds["commitment"],
        cells,
        round(shortest["guard_ms"] * 1e6),
        round(shortest["decide_ms"] * 1e6),
        content["golden"],
        hashlib.sha256(frozen.encode()).hexdigest()[:16],
    )


@cache
def entrants() -> dict[str, dict[str, Any]]:
    """The schemes that come with the package: settings by the name of their entry; ``bound`` marks bounds."""
    return {str(name): dict(settings) for name, settings in read_yaml(_HERE / "entrants.yaml", "entrants").items()}


def check_scheme(scheme: Mapping[str, Any]) -> None:
    """Whether an entry may set what it sets.

    :param scheme: settings by name.
    :raises ConfigError: naming what it may not set, or what is wrong.
    """
    for key, value in scheme.items():
        if key not in SCHEME_SETTINGS:
            raise ConfigError(f"set.{key}", value, ", ".join(SCHEME_SETTINGS[1:]))
    policy = scheme["policy"]
    for key, value in dict(scheme.get("options", {})).items():
        if not str(key).startswith(f"{policy}."):
            raise ConfigError(f"set.options.{key}", value, f"options of the policy: {policy}.NAME")
    POLICIES.row(policy)
