"""Settings and their errors; rows of policies, estimators and avoiders: complete, true, and the kernel's."""

from __future__ import annotations

from importlib.metadata import EntryPoint
from typing import Any

import numpy as np
import pytest
from slot_helpers import one_slot

from dtsa_agent.core import ConfigError, Swarm, SwarmConfig, registry
from dtsa_agent.core.kernel import NAMES
from dtsa_agent.core.registry import ESTIMATORS, POLICIES, PORT, PolicyRow
from dtsa_agent.core.settings.declaration import settings_of
from dtsa_agent.core.settings.flight_models import AVOIDERS, AvoiderParams, flight_model
from dtsa_agent.core.station import check_joinable


def flown(policy: str, shared: bool) -> Swarm:
    swarm = Swarm(SwarmConfig(agents=6, moving=4, policy=policy, seed=3), shared_table=shared)
    for slot in range(60):
        one_slot(swarm, slot)
    return swarm


def test_lists_of_names_are_the_kernels() -> None:
    assert NAMES["policies"] == POLICIES.names
    assert NAMES["estimators"] == ESTIMATORS.names
    assert NAMES["reasons"] == registry.REASONS == tuple(registry.REASON_TEXTS)
    assert set(NAMES) == {"policies", "estimators", "avoiders", "selections", "profiles", "reasons"}
    assert NAMES["avoiders"][AVOIDERS.row("bvc").kind] == "bvc"


def test_settings_and_rows_have_the_same_names() -> None:
    words = {spec.name: spec.choices for spec in settings_of(SwarmConfig)}
    for rows in (POLICIES, ESTIMATORS, AVOIDERS):
        assert words[rows.kind] == rows.names
        assert [rows.number(name) for name in rows.names] == list(range(len(rows.names)))
        assert rows.number("somebody's own") == len(rows.names)
        assert all(rows.row(name).name == name for name in rows.names)


@pytest.mark.parametrize("row", POLICIES.rows.values(), ids=lambda row: row.name)
def test_a_policy_is_what_its_row_says(row: PolicyRow) -> None:
    config = SwarmConfig(agents=6, moving=4, policy=row.name)
    own = flown(row.name, shared=False)
    assert config.extended == row.extended
    assert bool(own.lease_state.size) == row.agent_state
    assert bool(own.priority.any()) == row.weighs_all
    assert row.label
    assert set(row.port) <= set(PORT)
    assert row.own_bytes == 0  # of plug-ins only
    if row.may_share:
        assert np.array_equal(flown(row.name, shared=True).position, own.position)
    if row.agent_state:
        with pytest.raises(ConfigError, match="shared_table"):
            flown(row.name, shared=True)
        assert own.lease_status(0)["probation"] is False
        own.restart(0)
        own.begin(60)
        assert own.lease_status(0)["probation"] is row.probation
    own.leave(1)
    assert bool(own.present[1]) == row.says_leaving
    if row.may_join:
        check_joinable(row.name)
    else:
        with pytest.raises(ConfigError, match="policy"):
            check_joinable(row.name)


@pytest.mark.parametrize("row", ESTIMATORS.rows.values(), ids=lambda row: row.name)
def test_an_estimator_is_what_its_row_says(row: registry.EstimatorRow) -> None:
    config = SwarmConfig(agents=3, moving=2, policy="tdma", estimator=row.name)
    swarm = Swarm(config)
    swarm.begin(0)
    assert len(swarm.frame(0)) == (23 if row.needs_intent else 19)
    if row.needs_everybody:
        with pytest.raises(ConfigError, match="all agents in one process"):
            Swarm(config, local=[1])
    else:
        Swarm(config, local=[1])


def test_more_agents_than_frames_can_name_are_refused_with_what_is_possible() -> None:
    assert SwarmConfig(agents=254, policy="lease").extended
    with pytest.raises(
        ConfigError, match=r"agents: got 255; allowed: 1 to 254 .*1024 with policy tdma, dtsa, age, alo"
    ):
        SwarmConfig(agents=255, policy="lease")
    with pytest.raises(ConfigError, match=r"agents: got 300; allowed: 1 to 254 .*1024 with frame: paper"):
        SwarmConfig(agents=300, policy="tdma", frame="extended")
    assert SwarmConfig(agents=300, policy="tdma").agents == 300


def test_a_plug_in_named_like_a_built_in_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    for rows, name in ((POLICIES, "tdma"), (ESTIMATORS, "linear"), (AVOIDERS, "orca")):
        point = EntryPoint(name, "somebody:Thing", rows.group)
        monkeypatch.setattr("importlib.metadata.entry_points", lambda group, point=point: [point])
        with pytest.raises(ConfigError, match=f"{rows.group}: got '{name}'; allowed: another name for somebody:Thing"):
            rows.plug_ins()
        with pytest.raises(ConfigError, match="another name"):
            rows.row("somebody's own")


@pytest.mark.parametrize(
    ("what", "value"), [("own_bytes", 17), ("own_bytes", -1), ("own_bytes", True), ("port", ("send", "telepathy"))]
)
def test_what_a_policy_declares_is_checked(what: str, value: Any) -> None:
    with pytest.raises(ConfigError, match=f"odd.{what}"):
        POLICIES.register("odd", type("Odd", (), {what: value}))


def test_flight_models_take_the_kernels_parameters() -> None:
    for name in AVOIDERS.names:
        model = flight_model(name)
        assert model.kind == NAMES["avoiders"].index(model.avoider_kind)
        assert set(model.avoider.to_dict()) == {spec.name for spec in settings_of(AvoiderParams)}


def test_defaults_are_those_of_the_paper_where_it_has_some() -> None:
    config = SwarmConfig()
    assert (config.epsilon, config.r_min, config.slot_ms) == (0.5, 0.3, 10.0)
    assert config.moving == config.agents == 12


def test_all_but_one_of_an_odd_swarm_move_by_default() -> None:
    assert SwarmConfig(agents=7).moving == 6
    assert SwarmConfig(agents=1).moving == 0


@pytest.mark.parametrize(("field", "value", "allowed"), [
    ("agents", 0, "1 to 1024"), ("moving", 13, "the number of agents"), ("extent_m", 0.5, "1 to 10000 m"),
    ("policy", 7, "tdma, dtsa"), ("selection", "first", "candidates, pairwise"), ("slot_ms", -10, "0.3 to 1000 ms"),
    ("seed", -1, "0 to 9223372036854775807"), ("epsilon", 1.5, "0 to 1"), ("r_min", 0.0, "0.001 to 100 m"),
    ("options", {"v_mx": 1.0}, "v_max"), ("agents", 10**400, "1 to 1024"), ("options", {"gain": 10**400}, "a number"),
    ("agents", np.eye(2), "1 to 1024"),
])  # fmt: skip
def test_errors_name_field_value_and_what_is_allowed(field: str, value: object, allowed: str) -> None:
    with pytest.raises(ConfigError) as caught:
        SwarmConfig(**{field: value})  # type: ignore[arg-type]
    text = str(caught.value)
    assert field in text or "v_mx" in text
    assert allowed in text
    assert "\n" not in text


def test_an_error_does_not_repeat_a_whole_file() -> None:
    error = ConfigError("config", "x" * 100_000, "a mapping")
    assert len(str(error)) < 200
    assert str(error).endswith(" ...; allowed: a mapping")


def test_slots_are_cut_into_control_periods_of_ten_milliseconds_or_less() -> None:
    assert [SwarmConfig(slot_ms=ms).steps for ms in (1, 10, 10.5, 20, 50)] == [1, 1, 2, 2, 5]
    assert SwarmConfig(slot_ms=2.5).slot_ns == 2_500_000
