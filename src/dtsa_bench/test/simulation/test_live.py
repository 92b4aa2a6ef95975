"""Live agents on virtual time: what faults made of them once, and both statements of a station."""

from __future__ import annotations

import math
import shlex
import subprocess
import sys
from collections import defaultdict
from dataclasses import replace
from typing import Any, NamedTuple

import pytest
from plain_stations import STARTED, compare_statements, rules_of

from dtsa_agent.core.errors import ConfigError
from dtsa_agent.core.station import HoverReason
from dtsa_bench.simulation import live
from dtsa_bench.simulation.live import MS, LiveFault, LiveFlight, LiveResult, S, command_of, draw_flight, fly, shrink

both_policies = pytest.mark.parametrize("policy", ["tdma", "lease"])


class Sample(NamedTuple):
    """A station after a step."""

    at_s: float
    hovers: int
    restarts: int
    hears: int
    sent: int


class Watch:
    """Observes a flight: a sample a slot of each host, by the time since the flight, or the second process, began."""

    def __init__(self, flight: LiveFlight) -> None:
        self._starts = flight.starts_ns or (0,) * flight.agents
        self._zero: dict[int, int] = {}
        self._slots: dict[int, int] = {}
        self.samples: dict[int, list[Sample]] = defaultdict(list)
        self.result: LiveResult = fly(flight, self._note)
        assert not self.result.violation

    def _note(self, call: Any) -> None:
        host, status = call.host, call.status
        if call.kind == STARTED and host not in self._zero:
            self._zero[host] = call.now_ns - (self._starts[host] if host < len(self._starts) else 0)
        if status and status.slot != self._slots.get(host):
            self._slots[host] = status.slot
            at_s = (call.now_ns - self._zero[host]) / S
            self.samples[host].append(Sample(at_s, status.hovers, status.restarts, status.hears, status.sent))

    def between(self, host: int, begin_s: float, end_s: float) -> list[Sample]:
        samples = [sample for sample in self.samples[host] if begin_s <= sample.at_s <= end_s]
        assert samples
        return samples

    def flown_share(self, host: int, begin_s: float, end_s: float) -> float:
        samples = self.between(host, begin_s, end_s)
        return sum(sample.hovers == HoverReason.NONE for sample in samples) / len(samples)


def fault(kind: str, at_s: float, lasts_s: float, agent: int = 0, group: int = 0, amount: float = 0.0) -> LiveFault:
    return LiveFault(kind, round(at_s * S), round(lasts_s * S), agent, group, amount)


def notice_s(flight: LiveFlight) -> float:
    """Within this time an agent notices that it is not heard, or hears too few."""
    lists = math.ceil((flight.agents - 1) / 3) + 1
    return (6 + lists) * flight.main_every * flight.agents * flight.slot_ns / S + 0.5


# The table of faults that agents on a network did not survive once, row by row.


@both_policies
@pytest.mark.parametrize(("agents", "slot_ms"), [(4, 10), (6, 20), (12, 10)])
def test_groups_that_meet_at_any_offset_come_together(policy: str, agents: int, slot_ms: int) -> None:
    half = agents // 2
    for share in (0.11, 0.2, 0.3, 0.4, 0.49, 1.3, 2.5):
        offset_ns = round(share * slot_ms * MS)
        for starts in ((offset_ns,) * half + (0,) * half, (0,) * half + (offset_ns,) * half):
            flight = LiveFlight(
                round(share * 100), agents, policy, slot_ms * MS, starts_ns=starts,
                faults=(fault("partition", 0, 12, group=(1 << half) - 1),),
            )  # fmt: skip
            assert not fly(flight).violation, command_of(flight)


@both_policies
def test_groups_on_a_slow_radio_come_together(policy: str) -> None:
    for seed in range(10):
        flight = LiveFlight(
            seed, 6, policy, 20 * MS, airtime_ns=7 * MS, starts_ns=(seed * MS,) * 3 + (0,) * 3,
            faults=(fault("partition", 0, 12, group=0b111),),
        )  # fmt: skip
        assert not fly(flight).violation, command_of(flight)


@both_policies
@pytest.mark.parametrize("jitter_ms", [5, 10, 20])
def test_a_burst_of_jitter_does_not_split_a_swarm(policy: str, jitter_ms: int) -> None:
    for seed in range(20):
        burst = fault("jitter", 9, 1.5, amount=jitter_ms * MS)
        flight = LiveFlight(seed, 4 + 4 * (seed % 3), policy, faults=(burst,), lasts_ns=11 * S)
        assert not fly(flight).violation, command_of(flight)


@both_policies
def test_a_cold_start_ends_in_one_time(policy: str) -> None:
    for seed in range(60):
        starts = tuple((seed * 7919 + k * 104729) % 50 * MS for k in range(12))
        flight = LiveFlight(seed, 12, policy, starts_ns=starts, lasts_ns=S)
        assert not fly(flight).violation, command_of(flight)


@both_policies
@pytest.mark.parametrize("agents", [2, 3, 5, 8])
@pytest.mark.parametrize("kind", ["mute", "deaf"])
def test_an_agent_that_nobody_hears_or_that_hears_nobody_hovers(kind: str, agents: int, policy: str) -> None:
    for at_s in (0.3, 2.0, 14.0):
        flight = LiveFlight(1, agents, policy, drift_ppm=20, goal_every_ns=2 * S, faults=(fault(kind, at_s, 40, 1),))
        watch = Watch(flight)
        assert watch.flown_share(1, at_s + notice_s(flight), at_s + 40) == 0
        if agents > 3:  # the others need not this one
            assert watch.flown_share(0, at_s + 25, at_s + 40) == 1


@both_policies
@pytest.mark.parametrize("names", [1, 4])
def test_an_agent_that_restarts_and_that_nobody_hears_does_not_fly(names: int, policy: str) -> None:
    """None of the others has said yet that it does not hear this agent."""
    faults = fault("mute", 4, 40, 1), fault("crash", 20, 1, 1)
    watch = Watch(LiveFlight(1, 6, policy, names=names, drift_ppm=20, faults=faults))
    assert watch.flown_share(1, 20.5, 44) == 0


@both_policies
@pytest.mark.parametrize("at_s", [0.0, 0.3, 3.0, 14.0])
def test_of_two_processes_with_one_id_the_second_never_flies(at_s: float, policy: str) -> None:
    watch = Watch(LiveFlight(2, 5, policy, drift_ppm=20, faults=(fault("same-id", at_s, 30, 1),)))
    first, second = watch.between(1, at_s + 5, at_s + 30), watch.between(5, 5, 30)
    assert HoverReason.NONE not in {sample.hovers for sample in second}
    assert {sample.hovers for sample in second} == {HoverReason.SAME_ID}
    if at_s > 1:  # the first one was there before: it flies on
        assert {sample.hovers for sample in first} == {HoverReason.NONE}
        assert second[0].sent == second[-1].sent
    else:
        assert {sample.hovers for sample in first} in ({HoverReason.NONE}, {HoverReason.SAME_ID})


@both_policies
@pytest.mark.parametrize("lone", [0, 5])
def test_one_that_comes_back_in_another_time_does_not_disturb_the_others(lone: int, policy: str) -> None:
    """Clocks that drift apart by half a slot and more while an agent is away."""
    for step_ms in (-35, -7, 6, 13, 1000):
        away = fault("partition", 14, 10, group=1 << lone), fault("step", 15, 0.01, lone, amount=step_ms * MS)
        watch = Watch(LiveFlight(abs(step_ms), 6, policy, drift_ppm=20, faults=away))
        for host in {1, 3}:
            assert watch.flown_share(host, 14, 30) == 1
            assert len({sample.restarts for sample in watch.between(host, 14, 30)}) == 1


@both_policies
@pytest.mark.parametrize("agents", [4, 7])
@pytest.mark.parametrize("beyond", [-1400, -100, -1, 0, 200])
def test_slot_numbers_begin_anew_at_the_end_of_their_cycle(beyond: int, agents: int, policy: str) -> None:
    cycle = rules_of(LiveFlight(1, agents, policy)).slot_cycle
    for end in (cycle, 2**32):
        flight = LiveFlight(
            abs(beyond), agents, policy, drift_ppm=20, first_slot=end + beyond, lasts_ns=20 * S,
            faults=(fault("crash", 5, 4), fault("partition", 8, 9, group=1)),
        )  # fmt: skip
        assert not fly(flight).violation, command_of(flight)


@both_policies
@pytest.mark.parametrize("agents", [3, 8])
@pytest.mark.parametrize("a_second", [0.2, 10, 200])
def test_forged_slot_numbers_are_not_believed(a_second: float, agents: int, policy: str) -> None:
    """Any slot of any sender, in frames without a tag."""
    watch = Watch(LiveFlight(4, agents, policy, faults=(fault("forge", 12, 12, amount=a_second),)))
    for host in range(agents):
        assert watch.flown_share(host, 12, 26) == 1
        assert len({sample.restarts for sample in watch.between(host, 12, 26)}) == 1


@both_policies
@pytest.mark.parametrize("agents", [2, 6])
def test_an_agent_that_is_ahead_and_not_heard_comes_to_the_time_of_the_others(agents: int, policy: str) -> None:
    starts = (0, *(3 * S + 3 * MS,) * (agents - 1))
    watch = Watch(LiveFlight(3, agents, policy, starts_ns=starts, faults=(fault("mute", 0, 40),)))
    assert {sample.hears for sample in watch.between(0, 12, 40)} == {agents - 1}


@both_policies
def test_an_agent_whose_port_refuses_every_frame_hovers(policy: str) -> None:
    watch = Watch(LiveFlight(3, 4, policy, goal_every_ns=2 * S, faults=(fault("refuse", 14, 20, 1),)))
    turn_s = 5 * 4 * 0.01  # between its attempts at most
    assert watch.flown_share(1, 14 + 0.5 + 2 * turn_s, 34) == 0
    assert watch.flown_share(0, 16, 34) == 1


@both_policies
def test_both_halves_of_a_partition_and_what_restarts_in_it_hover(policy: str) -> None:
    flight = LiveFlight(3, 6, policy, faults=(fault("partition", 14, 40, group=0b111), fault("crash", 20, 3, 1)))
    watch = Watch(flight)
    for host in range(6):
        assert watch.flown_share(host, 14 + notice_s(flight), 54) == 0


@both_policies
def test_replays_do_not_make_an_agent_fly_that_is_cut_off(policy: str) -> None:
    for seed in (0, 2, 3):
        faults = fault("crash", 12, 3, 1), fault("partition", 12, 30, group=0b10), fault("replay", 12, 29, amount=100)
        watch = Watch(LiveFlight(seed, 5, policy, signed=True, faults=faults))
        assert watch.flown_share(1, 15, 42) == 0
        for host in (0, 2, 3, 4):
            assert watch.flown_share(host, 20, 42) == 1


@both_policies
@pytest.mark.parametrize("agents", [2, 4])
def test_links_that_are_one_way_for_good_end_in_hovering(agents: int, policy: str) -> None:
    """An agent that hears all, and that two others, or the only one, do not hear."""
    group = 0b110 & (1 << agents) - 1
    flight = LiveFlight(5, agents, policy, drift_ppm=20, faults=(fault("one-way", 0, 60, 0, group),))
    watch = Watch(flight)
    assert watch.flown_share(0, 10, 60) == 0
    assert watch.samples[0][-1].at_s > 60
    for host in range(1, agents):
        assert watch.flown_share(host, 25, 60) == (agents > 2)


@pytest.mark.parametrize("seed", [seed for seed in range(1, 70) if draw_flight(seed).lasts_ns == 5 * S])
def test_both_statements_of_a_station_are_equal_byte_by_byte(seed: int) -> None:
    assert compare_statements(draw_flight(seed)) > 500


@pytest.mark.parametrize("seed", [3, 19])
def test_a_seed_gives_the_same_bytes_in_every_process(seed: int) -> None:
    flight = draw_flight(seed)
    again = run_command(command_of(flight))
    assert again == repr(fly(flight))
    assert fly(draw_flight(seed)) == fly(flight)
    assert fly(replace(flight, seed=seed + 1)).hash != fly(flight).hash


def test_a_flight_or_seed_that_fails_is_shrunk_to_a_command(monkeypatch: pytest.MonkeyPatch) -> None:
    """Clocks that drift by a twentieth: nothing can hold the slots together."""
    flight = replace(draw_flight(8), drift_ppm=50_000)
    assert flight.faults
    result, simple = fly(flight), shrink(flight)
    assert result.violation == "not together in time"
    assert simple.faults == () == simple.starts_ns
    assert f"violation='{result.violation}'" in run_command(command_of(simple))
    assert "drift_ppm=50000" in command_of(simple)
    assert live.report_failure(8) == ""
    monkeypatch.setattr(live, "draw_flight", lambda seed: replace(draw_flight(seed), drift_ppm=50_000))
    report = live.report_failure(8)
    assert report.startswith("seed 8: not together in time")
    assert run_command(report.splitlines()[1]).startswith("LiveResult(violation='not together in time'")


@pytest.mark.parametrize("seed", [-1, True, 1.0, "7", 2**63, None])
def test_other_seeds_are_refused(seed: Any) -> None:
    with pytest.raises(ConfigError, match=f"seed: got {seed!r}; allowed: 0 to {2**63 - 1}"):
        draw_flight(seed)


@pytest.mark.parametrize(("settings", "field"), [
    ({"agents": 0}, "agents"), ({"agents": 63}, "agents"), ({"policy": "aloha"}, "policy"), ({"names": 5}, "names"),
    ({"slot_ns": 0}, "slot_ns"), ({"faults": (fault("mute", 1, 1, 4),)}, r"faults\[0\].agent"),
    ({"faults": (fault("quiet", 1, 1),)}, "kind"), ({"faults": (fault("mute", 1, 1),) * 65}, "faults"),
])  # fmt: skip
def test_flights_that_cannot_be_are_refused(settings: dict[str, Any], field: str) -> None:
    with pytest.raises(ConfigError, match=f"^{field}: got"):
        LiveFlight(1, **settings)


def run_command(command: str) -> str:
    words = shlex.split(command)
    assert words[0] == "python"
    done = subprocess.run([sys.executable, *words[1:]], capture_output=True, text=True, check=True, timeout=120)
    return done.stdout.strip()
