"""Integration: every settings object survives a round trip through plain values, JSON, YAML and ROS parameters."""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Iterator
from typing import Any

import pytest
import yaml
from hypothesis import HealthCheck, assume, given, settings
from hypothesis import strategies as st

from dtsa_agent.core.errors import ConfigError
from dtsa_agent.core.settings.config import SwarmConfig
from dtsa_agent.core.settings.declaration import REQUIRED, Setting, Settings, nested, setting, settings_of
from dtsa_agent.core.settings.flight_models import FLIGHT_MODELS, AvoiderParams, FlightModel, VehicleParams
from dtsa_agent.crazyflie.safety import SafetySettings
from dtsa_agent.crazyflie.settings import parse_swarm
from dtsa_bench.crazyflies.simulated import FleetConfig
from dtsa_bench.experiments import sweep as spec
from dtsa_bench.experiments.sweep import MEASURES, RESERVED
from dtsa_bench.runs.config import LOCKSTEP, MODES, RunConfig, RunLimits
from dtsa_channel_sim import ChannelConfig, ClockConfig

MANY = settings(deadline=None, max_examples=60, suppress_health_check=[HealthCheck.filter_too_much])


def value_of(spec: Setting) -> st.SearchStrategy[Any]:
    if spec.choices:
        return st.sampled_from(spec.choices)
    low, high = spec.minimum, spec.maximum
    if spec.kind == "int":
        return st.integers(int(low or 0), int(high or 0))
    if spec.kind == "float":
        return st.floats(low, high)
    if spec.kind == "bool":
        return st.booleans()
    if spec.kind == "vector":
        return st.tuples(*[st.floats(-1e3, 1e3)] * 3)
    return st.text(max_size=20)


def some_of(cls: type[Settings], *left_out: str) -> st.SearchStrategy[dict[str, Any]]:
    fields = {spec.name: value_of(spec) for spec in settings_of(cls) if not spec.custom and spec.name not in left_out
              and spec.kind not in ("structure", "values")}  # fmt: skip
    return st.fixed_dictionaries({}, optional=fields)


def allowed(cls: type[Settings], values: dict[str, Any]) -> Any:
    try:
        return cls(**values)
    except ConfigError:
        assume(False)


MODEL_VALUES = st.dictionaries(st.sampled_from(["v_max", "tau", "spacing", "rule.limit"]), st.floats(0.5, 1.0))
LINK = {"from": 1, "to": [2, 3], "loss": 0.25, "both_ways": True}
STRUCTURES: dict[str, st.SearchStrategy[Any]] = {
    "loss_matrix": st.lists(st.lists(st.floats(0, 1), min_size=4, max_size=4), min_size=4, max_size=4),
    "link_loss": st.lists(st.just(LINK) | st.builds(lambda p: {"from": 4, "loss": p}, st.floats(0, 1))),
    "schedule": st.lists(
        st.fixed_dictionaries(
            {"slot": st.integers(0, 1000)},
            optional={"jam": st.booleans(), "link_loss": st.just([LINK]), "partition": st.just([[1, 3], [2, 4]])},
        ).filter(lambda entry: len(entry) > 1),
        max_size=3,
    ),
    "partition": st.sampled_from(["", [[1, 2], [3, 4]], [[4]]]),
}


@st.composite
def swarms(draw: st.DrawFn, **fixed: Any) -> SwarmConfig:
    values = draw(some_of(SwarmConfig, "moving")) | {"options": draw(MODEL_VALUES)} | fixed
    if draw(st.booleans()):
        values["moving"] = 2 * draw(st.integers(0, values.get("agents", 12) // 2))
    return allowed(SwarmConfig, values)


@st.composite
def channels(draw: st.DrawFn, **fixed: Any) -> ChannelConfig:
    bursts = draw(st.sampled_from([{}, {"loss": 0.1, "burst_length": 5.0}]))
    plain = draw(some_of(ChannelConfig, "agents", "burst_length", "p_good", "p_bad"))
    values = plain | bursts | draw(st.fixed_dictionaries({}, optional=STRUCTURES)) | {"agents": 4} | fixed
    return allowed(ChannelConfig, values)


@st.composite
def runs(draw: st.DrawFn) -> RunConfig:
    swarm = draw(swarms(agents=4))
    channel = draw(st.none() | channels(slot_ns=swarm.slot_ns))
    limits, clocks = RunLimits(**draw(some_of(RunLimits))), ClockConfig(**draw(some_of(ClockConfig)))
    values = {"swarm": swarm, "channel": channel, "limits": limits, "clocks": clocks}
    return allowed(RunConfig, values | {"mode": draw(st.sampled_from(MODES)), "align": draw(st.booleans())})


def objects(cls: type[Settings]) -> st.SearchStrategy[Any]:
    special: dict[type, st.SearchStrategy[Any]] = {SwarmConfig: swarms(), ChannelConfig: channels(), RunConfig: runs()}
    return special[cls] if cls in special else some_of(cls).map(lambda values: allowed(cls, values))


def ways(values: dict[str, Any], sort: bool = True) -> Iterator[dict[str, Any]]:
    """Plain values as they are, and as they come back from JSON and from YAML, there in another order."""
    yield values
    yield json.loads(json.dumps(values, allow_nan=False))
    yield yaml.safe_load(yaml.safe_dump(values, sort_keys=sort))


@pytest.mark.parametrize(
    "cls",
    [SwarmConfig, ChannelConfig, ClockConfig, RunLimits, RunConfig, AvoiderParams, VehicleParams, SafetySettings,
     FleetConfig],
    ids=lambda cls: cls.__name__,
)  # fmt: skip
@MANY
@given(data=st.data())
def test_settings_survive_plain_values_json_and_yaml(cls: type[Settings], data: st.DataObject) -> None:
    config = data.draw(objects(cls))
    for values in ways(config.to_dict()):
        assert cls.from_dict(values) == config


@pytest.mark.parametrize("cls", [SwarmConfig, ChannelConfig, RunLimits, SafetySettings], ids=lambda cls: cls.__name__)
@MANY
@given(data=st.data())
def test_settings_survive_a_file_of_ros_parameters(cls: type[Settings], data: st.DataObject) -> None:
    parameters = pytest.importorskip("dtsa_agent.ros.common.parameters")
    config = data.draw(objects(cls))
    file = yaml.safe_dump({"/**": {"ros__parameters": parameters.to_parameters(config.to_dict(), cls)}})
    read = yaml.safe_load(file)["/**"]["ros__parameters"]
    known = {spec.name: spec for spec in settings_of(cls)}
    files_only = {name: value for name, value in config.to_dict().items() if known[name].kind == "structure"}
    values = {name: parameters.from_parameter(known[name], value) for name, value in read.items()}
    assert cls.from_dict({**values, **files_only}) == config


@pytest.mark.parametrize("model", FLIGHT_MODELS.values(), ids=lambda model: model.name)
def test_flight_models_survive(model: FlightModel) -> None:
    for values in ways(model.to_dict()):
        assert FlightModel.from_dict(values) == model


ROBOTS = {
    "robots": {
        "cf2": {"uri": "radio://0/80/2M/E7E7E7E702", "type": "small", "initial_position": [1, 2, 0.5]},
        "cf7": {"uri": "udp://127.0.0.1:19850", "reset_estimator": False},
    },
    "robot_types": {"small": {"command_rate_hz": 20, "battery": {"flight_warning": 3.6}}},
    "all": {"firmware_params": {"stabilizer": {"estimator": 2}, "ctrlMel": {"kp_xy": 0.4}}},
    "station": {"min_connected": 2, "safety": {"geofence_max": [2, 3, 1], "heartbeat_s": 0}},
}


def test_a_swarms_yaml_survives() -> None:
    swarm = parse_swarm(ROBOTS)
    assert swarm.robots[0].firmware_params == {"stabilizer.estimator": 2, "ctrlMel.kp_xy": 0.4}
    for values in ways(ROBOTS):
        again = parse_swarm(values)
        assert again == swarm
        assert isinstance(again.robots[0].firmware_params["stabilizer.estimator"], int)


@pytest.mark.parametrize("name", spec.preset_names())
def test_sweeps_survive(name: str) -> None:
    sweep = spec.load_preset(name, seeds=3)
    for values in ways(sweep.spec.to_dict(), sort=False):  # the order of levels is that of the report
        assert spec.SweepSpec.from_dict(values) == sweep.spec
        assert spec.make_sweep(values, name) == sweep


def test_bags_of_before_are_read() -> None:
    """Lockstep runs once recorded no mode, and whole numbers stood where floats are meant."""
    old = {
        "swarm": {"agents": 4, "slot_ms": 20}, "channel": {"agents": 4, "slot_ns": 20_000_000}, "limits": {"tail_s": 2},
    }  # fmt: skip
    run = RunConfig.from_dict(old)
    assert (run.mode, run.align, run.clocks) == (LOCKSTEP, True, ClockConfig())
    assert run == RunConfig(SwarmConfig(agents=4, slot_ms=20.0), limits=RunLimits(tail_s=2.0), channel=run.channel)
    assert isinstance(run.swarm.slot_ms, float)


def make(name: str, **fields: tuple[str, Any]) -> type[Settings]:
    spec = {key: kind for key, (kind, _) in fields.items()}
    body = {key: default for key, (_, default) in fields.items()} | {"__annotations__": spec}
    return dataclasses.dataclass(frozen=True)(type(name, (Settings,), body))


PART = make("Part", size=("float", setting(1.0, "size", unit="m", minimum=0, maximum=2)))
WHOLE = make(
    "Whole", count=("int", setting(REQUIRED, "count", minimum=1, maximum=9)),
    share=("float", setting(0.5, "share", minimum=0, maximum=1)), on=("bool", setting(True, "on")),
    color=("str", setting("red", "color", choices=("red", "green"))),
    plug=("str", setting("a", "plug", choices=("a", "b"), open_choices=True)),
    place=("Vector", setting((0.0, 0.0, 0.0), "place", unit="m")),
    level=("int | None", setting(None, "level", minimum=0, maximum=3)),
    values=("Mapping[str, float]", setting({}, "values")), part=("Part", nested(PART, "part")),
)  # fmt: skip


@pytest.mark.parametrize(("values", "message"), [
    ({}, "count: got None; allowed: a whole number, 1 to 9"), ({"count": 10}, "count: got 10; allowed: 1 to 9"),
    ({"count": 1.5}, "count: got 1.5; allowed: a whole number, 1 to 9"),
    ({"count": True}, "count: got True; allowed: a whole number, 1 to 9"),
    ({"count": None}, "count: got None; allowed: a whole number, 1 to 9"),
    ({"count": 1, "share": 2}, "share: got 2; allowed: a number from 0 to 1"),
    ({"count": 1, "share": float("nan")}, "share: got nan; allowed: a number from 0 to 1"),
    ({"count": 1, "on": 1}, "on: got 1; allowed: true or false"),
    ({"count": 1, "color": "blue"}, "color: got 'blue'; allowed: red, green"),
    ({"count": 1, "plug": 7}, "plug: got 7; allowed: a, b"),
    ({"count": 1, "place": [1, 2]}, "place: got [1, 2]; allowed: three numbers: x, y, z in m"),
    ({"count": 1, "level": -1}, "level: got -1; allowed: 0 to 3"),
    ({"count": 1, "values": {"a": "b"}}, "values.a: got 'b'; allowed: a number"),
    ({"count": 1, "values": 3}, "values: got 3; allowed: names with values"),
    ({"count": 1, "part": {"size": 3}}, "part.size: got 3; allowed: 0 to 2 m"),
    ({"count": 1, "part": {"size": "x"}}, "part.size: got 'x'; allowed: a number, 0 to 2 m"),
    ({"count": 1, "part": 3}, "part: got 3; allowed: names with values"),
    ({"count": 1, "cuont": 1}, "cuont: got 1; allowed: one of the settings count, share"),
])  # fmt: skip
def test_errors_name_the_setting_the_value_and_what_is_allowed(values: dict[str, Any], message: str) -> None:
    with pytest.raises(ConfigError) as caught:
        WHOLE.from_dict(values)
    assert str(caught.value).startswith(message)


def test_values_are_stored_as_their_kind() -> None:
    whole: Any = WHOLE.from_dict({"count": 3.0, "share": 1, "plug": "mine", "place": [1, 2, 3], "part": {"size": 2}})
    assert [type(value) for value in (whole.count, whole.share, whole.part.size)] == [int, float, float]
    assert (whole.plug, whole.place, whole.level) == ("mine", (1.0, 2.0, 3.0), None)
    assert WHOLE.from_dict(whole.to_dict()) == whole


@pytest.mark.parametrize(("name", "text", "value"), [
    ("count", "7", 7), ("share", "1", 1.0), ("on", "no", False), ("color", "green", "green"),
    ("values", "a=1, b=-2.5", {"a": 1.0, "b": -2.5}),
])  # fmt: skip
def test_texts_are_read(name: str, text: str, value: Any) -> None:
    spec = next(spec for spec in settings_of(WHOLE) if spec.name == name)
    assert spec.read(text) == value
    with pytest.raises(ConfigError, match=f"^{name}: got 'maybe'; allowed: "):
        spec.read("maybe")


@pytest.mark.parametrize("axis", ["cell", "status", "seed", "collided", "runs", "crashed", "age_mean_slots"])
def test_axes_are_not_called_like_columns_of_the_results(axis: str) -> None:
    with pytest.raises(ConfigError) as caught:
        spec.make_sweep({"axes": {axis: {"a": {"agents": 4}, "b": {"agents": 6}}}}, "s")
    assert caught.value.field == f"axes.{axis}"


def test_columns_of_results_are_reserved_and_every_setting_has_a_help_text() -> None:
    assert set(MEASURES) <= RESERVED
    settings_names = {spec.name for cls in (SwarmConfig, ChannelConfig, RunLimits) for spec in settings_of(cls)}
    assert RESERVED & settings_names == {"seed"}
    for cls in (SwarmConfig, ChannelConfig, ClockConfig, RunLimits, RunConfig, SafetySettings, FleetConfig):
        assert all(spec.help for spec in settings_of(cls)), cls.__name__
