"""Integration: the league: what is frozen, what an entry holds, what a check finds."""

from __future__ import annotations

import pytest

from dtsa_agent.core.errors import ConfigError
from dtsa_agent.core.registry import POLICIES
from dtsa_bench.experiments.league.cells import check_scheme, entrants, league
from dtsa_bench.experiments.league.flight import golden_digest
from dtsa_bench.experiments.sweep.spec import run_config

LEAGUE = league()


def test_the_simulator_flies_the_cells_as_they_were_frozen() -> None:
    # A change of what is computed needs a league of another number: docs/how-to/league.md.
    assert LEAGUE.digest == "57a6b9c7c9bd0cf1"
    assert golden_digest(LEAGUE) == LEAGUE.golden["digest"]


def test_seeds_follow_from_word_cell_and_number() -> None:
    assert LEAGUE.seed("practice", "few", 0) == 1926344029
    seeds = {LEAGUE.seed("practice", cell.name, k) for cell in LEAGUE.cells for k in range(LEAGUE.count)}
    assert len(seeds) == len(LEAGUE.cells) * LEAGUE.count
    assert all(0 <= seed < 2**31 for seed in seeds)
    with pytest.raises(ConfigError, match="secret"):
        LEAGUE.check_secret("practice")


def test_all_built_in_schemes_are_entrants_and_fly_every_cell() -> None:
    flown = {settings["policy"] for settings in entrants().values()}
    assert flown >= {
        *POLICIES.rows,
        *(name for name, point in POLICIES.plug_ins().items() if "dtsa_bench" in point.value),
    }
    for settings in entrants().values():
        scheme = {key: value for key, value in settings.items() if key != "bound"}
        check_scheme(scheme)
        for cell in LEAGUE.cells:
            run_config(LEAGUE.settings(cell, scheme, 1))
