"""Settings are checked once, and errors name the field, the value and what is allowed."""

from __future__ import annotations

import pytest

from dtsa_agent.core import ConfigError, SwarmConfig


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
    ("options", {"v_mx": 1.0}, "v_max"),
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
