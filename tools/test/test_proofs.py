"""Integration: libdtsa outside of Python: fuzzed, proved, and on a microcontroller."""

from __future__ import annotations

import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest
from dtsa_dev.embedded import (
    FUSING,
    STACK_BYTES,
    check_board_program,
    fly_app_on_cortex,
    fly_here,
    fly_on_cortex,
    fused,
)
from dtsa_dev.proofs.programs import LIBRARY, FuzzFinding, NotHere, build, fuzz
from dtsa_dev.prove import MUTANTS, Scope, explore
from dtsa_dev.prove import build as build_prover


@contextmanager
def skipped_if_not_here() -> Iterator[None]:
    try:
        yield
    except NotHere as error:
        pytest.skip(str(error))


@pytest.mark.parametrize(("target", "inputs"), [("frames", 200_000), ("agents", 10_000), ("station", 20_000)])
def test_fuzzing_finds_nothing(target: str, inputs: int, tmp_path: Path) -> None:
    with skipped_if_not_here():
        program = build(target, tmp_path)
    done = fuzz(program, 120, tmp_path / "corpus", seed=1, most=inputs)
    assert done.runs >= inputs
    assert done.covered > 50  # it got past the first checks


def test_fuzzing_finds_a_missing_check(tmp_path: Path) -> None:
    broken = shutil.copytree(LIBRARY, tmp_path / "libdtsa")
    source, check = broken / "frame_extended.c", "if (count > RELAY_IDS) return FRAME_BAD_FIELD;"
    assert check in source.read_text()
    source.write_text(
        source.read_text()
        .replace(check, "")
        .replace("i < RELAY_IDS; i++) {\n        e->relay", "i < count; i++) {\n        e->relay")
    )
    with skipped_if_not_here():
        program = build("frames", tmp_path, broken)
    with pytest.raises(FuzzFinding, match=r"overflow|out of bounds|ABRT|deadly"):
        fuzz(program, 20, tmp_path / "corpus", seed=1)


def test_a_microcontroller_flies_the_same_bits(tmp_path: Path) -> None:
    with skipped_if_not_here():
        cortex = fly_on_cortex(tmp_path, slots=30, metered=False)
    here = fly_here(tmp_path, slots=30)
    assert [(flight.policy, flight.agents) for flight in here] == [
        (policy, agents) for policy in ("tdma", "dtsa", "lease") for agents in (12, 18)
    ]
    assert [flight.digest for flight in cortex] == [flight.digest for flight in here]
    assert len({flight.digest for flight in here}) == 6
    assert all(flight.memory < 8192 for flight in cortex)


def test_what_measures_the_app_on_board_compiles(tmp_path: Path) -> None:
    """On this machine, too, which has no compiler for microcontrollers."""
    check_board_program(tmp_path)


def test_a_slot_of_the_app_on_board_fits_its_stack_and_its_time(tmp_path: Path) -> None:
    with skipped_if_not_here():
        (cost,) = fly_app_on_cortex(tmp_path, slots=5, sample=True)
    assert (cost.policy, cost.agents, cost.slots) == ("lease", 20, 5)  # it steers
    assert 1000 < cost.stack < STACK_BYTES
    assert all(mean <= most for mean, most in cost.instructions.values())
    assert 10_000 < cost.instructions["slot"][1] < 840_000  # half a slot of 1.68 million cycles


def test_a_firmware_that_fuses_operations_flies_the_same_bits(tmp_path: Path) -> None:
    """Its flags allow it, libdtsa's sources forbid it; without that rule the same sources have fused operations."""
    copy = tmp_path / "libdtsa"
    shutil.copytree(LIBRARY, copy)
    (copy / "rounding.h").write_text("")
    with skipped_if_not_here():
        assert fused(tmp_path) == {}
        assert set(fused(tmp_path, copy)) == {"orca_scalar.c", "urgent.c"}
        cortex = fly_on_cortex(tmp_path, slots=30, metered=False, more=FUSING)
    assert [flight.digest for flight in cortex] == [flight.digest for flight in fly_here(tmp_path, slots=30)]


def test_code_for_software_doubles_gives_the_same_bits(tmp_path: Path) -> None:
    """Here, where a longer flight costs nothing: meetings, overlaps, arrivals."""
    plain, soft = (fly_here(tmp_path, slots=1500, soft=soft) for soft in (False, True))
    assert [flight.digest for flight in soft] == [flight.digest for flight in plain]


@pytest.mark.parametrize("adoption", [False, True])
def test_every_state_of_three_agents_keeps_the_rules(adoption: bool, tmp_path: Path) -> None:
    """Through a restart, a death and what it leads to, for all patterns of loss."""
    claims = 1 if adoption else 0
    scope = Scope("three agents", 3, adoption=adoption, restarts=1, deaths=1, returns=0, claims=claims)
    whole = explore(build_prover(tmp_path), scope)
    assert whole.closed
    assert not whole.broken
    assert whole.states > 1_000


def test_anchors_that_are_given_away_keep_the_rules(tmp_path: Path) -> None:
    """OPEN turns, adoption, a restart, a wrong claim; one anchor in two is a main one."""
    scope = Scope(
        "two agents", 2, anchor_rest=2, open_every=3, adoption=True, restarts=1, deaths=0, returns=0, claims=1
    )
    whole = explore(build_prover(tmp_path), scope)
    assert whole.closed
    assert not whole.broken
    assert whole.states > 1_000


def test_every_broken_rule_is_found(tmp_path: Path) -> None:
    found = {mutant.rule: explore(build_prover(tmp_path, mutant), mutant.scope).broken for mutant in MUTANTS}
    assert all(found.values()), [rule for rule, broken in found.items() if not broken]
    assert len({mutant.right for mutant in MUTANTS}) >= 8
