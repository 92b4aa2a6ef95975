"""Schemes of the literature, and bounds: numbers of their sources, and what they may not do."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from dtsa_dev.protocol.experiment import Experiment
from dtsa_dev.protocol.optimum import optimum

import dtsa
from dtsa_agent.core import AgentGroup, ConfigError, SwarmConfig
from dtsa_agent.core.errors import PluginError
from dtsa_agent.core.plugins import Table, make_swarm
from dtsa_agent.core.registry import POLICIES
from dtsa_agent.crazyflie.settings import GroundStationSettings, SwarmSettings
from dtsa_agent.stop import Stop
from dtsa_bench.crazyflies.missions.mission_flight import fly_crazyflies
from dtsa_bench.experiments.sweep import run_config
from dtsa_bench.flights.flight import FlightOptions, check_options
from dtsa_bench.runs.config import RunConfig
from dtsa_bench.simulation.schemes.knowledge import whittle_index
from dtsa_bench.simulation.schemes.mixer import FrameSolver
from dtsa_bench.simulation.schemes.tdma import Sotdma
from dtsa_bench.simulation.simulate import simulate
from dtsa_bench.simulation.unslotted import UnslottedTraffic
from dtsa_channel_sim import Channel, ChannelConfig
from dtsa_channel_sim.model.airtime import Airtime
from dtsa_channel_sim.model.verdict import COLLISION


def steady(policy: str, agents: int, movers: int, loss: float = 0.0, slots: int = 3000, **settings: Any) -> Experiment:
    """Some circle, the rest hover."""
    warmup = settings.pop("warmup", 20 * agents)
    config = SwarmConfig(agents=agents, moving=0, avoider="none", seed=3, policy=policy, **settings)
    channel = ChannelConfig(agents=agents, slot_ns=config.slot_ns, seed=3, loss=loss)
    experiment = Experiment(config, channel, movers=range(1, movers + 1), warmup=warmup)
    experiment.run(slots)
    return experiment


def test_without_loss_the_genie_reaches_the_bound_and_nobody_gets_below_it() -> None:
    """(N_p - 1) / 2: round robin over the movers."""
    assert steady("genie-age", 12, 6).outcome.age == pytest.approx(2.5)
    for policy in ("tdma", "lease", "genie-error", "genie-innovation", "dtsa"):
        assert steady(policy, 12, 6).outcome.age > 2.5 - 1e-9


@pytest.mark.parametrize("loss", [0.05, 0.3])
def test_nobody_is_ahead_of_the_genie_under_loss(loss: float) -> None:
    genie = steady("genie-age", 12, 6, loss, frame="extended").outcome.age
    assert genie < steady("lease", 12, 6, loss).outcome.age < steady("tdma", 12, 6, loss).outcome.age
    assert genie < steady("tdma", 12, 6, loss, frame="extended").outcome.age


def test_greedy_is_almost_optimal_for_three_agents_and_tdma_is_that_of_the_simulation() -> None:
    perfect = optimum(0.0, cap=4)
    assert perfect.best == perfect.greedy == perfect.tdma == pytest.approx(1.0)
    lossy = optimum(0.2, cap=6, tolerance=1e-4)
    assert lossy.best <= lossy.greedy < 1.005 * lossy.best < 0.95 * lossy.tdma
    assert lossy.greedy < lossy.whittle < 1.01 * lossy.best
    simulated = steady("tdma", 3, 3, 0.2, slots=40_000).outcome.age
    assert simulated == pytest.approx(optimum(0.2, cap=4, tolerance=1e-3).tdma, rel=0.03)


@pytest.mark.parametrize("loss", [0.0, 0.1, 0.5])
def test_whittles_index_is_the_price_at_which_waiting_costs_as_much(loss: float) -> None:
    """One link that sends from an age on, at a price a frame: that age and the next one are then equally good."""
    arrives = 1.0 - loss

    def cost(first: int, price: float) -> float:
        lengths = first - 1 + np.arange(1, 400)  # of the time between two frames that arrive; ages run from 1 to it
        share = arrives * loss ** np.arange(399)
        return float((share @ (lengths * (lengths + 1) / 2) + price / arrives) / (share @ lengths))

    for age in (1, 2, 5, 12):
        price = float(whittle_index(np.array(float(age)), loss))
        assert cost(age, price) == pytest.approx(cost(age + 1, price), rel=1e-12)
        assert min(cost(other, price) for other in range(1, 20)) == pytest.approx(cost(age, price), rel=1e-12)


def test_whittles_index_is_close_to_the_genie_and_needs_a_probability() -> None:
    genie = steady("genie-age", 12, 6, 0.3).outcome.age
    assert genie < steady("whittle", 12, 6, 0.3, options={"whittle.loss": 0.3}).outcome.age < 1.05 * genie
    assert steady("whittle", 12, 6).outcome.age == pytest.approx(2.5)
    with pytest.raises(ConfigError, match=r"whittle\.loss: got 1\.0; allowed: 0 to below 1"):
        make_swarm(SwarmConfig(agents=4, policy="whittle", options={"whittle.loss": 1.0}))


def mean_error(policy: str) -> float:
    """Of flights in which half of the agents move, m."""
    flights = [dtsa.simulate(agents=12, moving=6, policy=policy, slot_ms=30, seed=seed) for seed in range(1, 5)]
    return float(np.mean([flight.summary["estimate_error_mean_m"] for flight in flights]))


def test_the_genie_by_error_has_the_least_errors_and_dominance_prefers_those_who_turn() -> None:
    """Squared errors, which it weighs: of few that move, those that turn are worth more than those that do not."""
    assert mean_error("genie-error") < mean_error("genie-age") < mean_error("tdma")
    assert mean_error("dominance") < mean_error("tdma")


def test_threshold_aloha_has_the_age_of_its_source() -> None:
    """1.4169 n for many agents, ages counted from 1."""
    ages = steady("threshold-aloha", 200, 200, slots=4000, warmup=1200).outcome
    assert (ages.age + 1) / 200 == pytest.approx(1.4169, rel=0.05)


def delivered(share: float, loss: float, agents: int = 12) -> float:
    """Share of the frames of each round of Mixer that an agent has before the next one, by the slots they are from."""
    run = run_config({
        "policy": "mixer", "agents": agents, "avoider": "none", "loss": loss, "seed": 3, "timeout_s": 8, "tail_s": 9,
        "stop_on_crash": False, "options": {"mixer.slots_per_agent": share},
    })  # fmt: skip
    log = simulate(run, log=True, observer=1).log
    period = round(share * agents)
    ends = log.heard_slot[2 * period - 2 :: period, 1:]
    return float((ends == period * np.arange(1, len(ends) + 1)[:, None]).mean())


def test_a_round_of_mixer_brings_all_states_to_all_also_where_frames_are_lost() -> None:
    """Each packet helps whatever an agent lacks: a fifth lost costs next to nothing."""
    assert delivered(2.0, 0.0) == 1.0
    assert delivered(2.0, 0.05) > 0.99
    assert delivered(3.0, 0.2) > 0.99
    assert delivered(1.5, 0.2) < 0.95  # fewer packets than it takes
    assert delivered(2.0, 0.05, agents=40) > 0.99  # rounds of three slots


def test_what_mixer_combines_is_solved_for_as_soon_as_there_are_enough() -> None:
    draw, frames = np.random.default_rng(1), {k: int(v) for k, v in enumerate(range(100, 110), 1)}
    heard, count = FrameSolver(), 0
    while len(heard.rows) < len(frames):
        vector = int(draw.integers(1, 1 << len(frames)))
        mixed = 0
        for k, frame in frames.items():
            mixed ^= frame if vector >> (k - 1) & 1 else 0
        heard.add(vector, mixed)
        count += 1
    assert heard.solved() == frames
    assert count <= len(frames) + 8  # random sums: the chance of needing so many is 1 in 250


def test_who_is_known_as_it_is_does_not_send_by_the_age_of_incorrect_information() -> None:
    """Larger errors that are borne cost fewer frames, and are there: in the mean a third of the bound."""
    loose = {"threshold-aoii.error_m": 0.5, "threshold-aoii.rate": 1.0}
    settings = {"policy": "threshold-aoii", "agents": 12, "moving": 2, "seed": 2, "timeout_s": 20}
    few, many = (
        simulate(run_config({**settings, "options": options})).summary()
        for options in (loose, {"threshold-aoii.error_m": 0.02})
    )
    assert few["frames_per_s"] < 0.8 * many["frames_per_s"]
    assert 0.05 < few["estimate_error_mean_m"] < 0.5
    with pytest.raises(ConfigError, match=r"threshold-aoii\.rate: got 0"):
        simulate(run_config({**settings, "options": {"threshold-aoii.rate": 0.0}}))


def test_first_reports_of_sotdma_that_enter_by_random_access_collide_as_often_as_slots_are_equal() -> None:
    """All are switched on at once and each begins in any of L slots: 1 - (1 - 1 / L)^(N - 1), 0.38 for 20 in 40."""
    collided, first = 0, 0
    for seed in range(15):
        settings = {"policy": "sotdma", "agents": 20, "seed": seed, "timeout_s": 2, "options": {"sotdma.entry": 1}}
        log = simulate(run_config(settings), log=True).log
        seen: set[int] = set()
        for senders in log.senders():
            new = set(senders) - seen
            collided += len(new) if len(senders) > 1 else 0
            first += len(new)
            seen |= new
        assert len(seen) == 20
    assert first == 300
    assert collided / first == pytest.approx(1 - (1 - 1 / 40) ** 19, abs=0.1)  # more than three standard deviations


@pytest.mark.parametrize("seed", range(8))
def test_a_first_report_of_sotdma_keeps_out_of_slots_that_others_have_announced_meanwhile(seed: int) -> None:
    """Frames have 12 slots. Another agent announces each slot just before it, but for four of them."""
    config = SwarmConfig(agents=6, policy="sotdma", seed=seed, options={"sotdma.entry": 1})
    agent, table, free = Sotdma(config, 1), Table(make_swarm(config), 0), range(30, 34)
    sent = -1
    for slot in range(12, 36):
        if slot not in free:
            agent.receive_data(table, slot - 1, 2, bytes((0, 1, 0)))
        if sent < 0 and agent.choose(table, slot) == 1:
            sent = slot
    assert sent in free


@pytest.mark.parametrize(("free", "taken"), [(None, 22), (23, 23)])
def test_an_agent_of_sotdma_that_finds_no_free_slot_may_take_that_of_the_agent_farthest_away(free, taken):
    """Frames have 12 slots: the first report of agent 5 comes in slot 21, 22 or 23."""
    config = SwarmConfig(agents=6, policy="sotdma", options={"sotdma.reuse": 1})
    swarm = make_swarm(config)
    agent, table = Sotdma(config, 5), Table(swarm, 0)
    for owner, away_m in ((1, 3.0), (2, 9.0), (3, 2.0), (5, 0.0)):
        swarm.sent_position[0][:, owner - 1] = (away_m, 0.0, 0.0)
    for owner, slot in ((1, 21), (2, 22), (3, 23)):
        if slot != free:
            agent.receive_data(table, 11, owner, bytes((0, slot - 11, 0)))
    sent = [slot for slot in range(12, 24) if agent.choose(table, slot) == 5]
    assert sent == [taken]


def traffic(policy: str, slots: int, **settings: object) -> tuple[UnslottedTraffic, list[object], SwarmConfig]:
    config = SwarmConfig(agents=20, policy=policy, seed=5, slot_ms=2, **settings)
    swarm = make_swarm(config)
    air = UnslottedTraffic(swarm, Channel(ChannelConfig(agents=20, slot_ns=config.slot_ns, seed=5)))
    return air, [air.slot(slot) for slot in range(slots)], config


@pytest.mark.parametrize(("load", "most"), [(0.5, 1 / (2 * math.e)), (0.1, 0.1 * math.exp(-0.2))])
def test_pure_aloha_carries_what_the_textbook_says(load: float, most: float) -> None:
    """G e^(-2 G) of the air carries whole frames."""
    _, carried, config = traffic("pure-aloha", 4000, options={"pure-aloha.load": load})
    whole = sum(len(slot.heard) for slot in carried)
    share = whole * Airtime().on_air_ns(config.frame_length) / (4000 * config.slot_ns)
    assert share == pytest.approx(most, rel=0.05)


def test_carrier_sense_helps_where_frames_are_longer_than_the_turn_round_of_radios() -> None:
    """Who finds the air free needs 0.13 ms to send: as long as a frame of 19 bytes is, half as long as one of 60."""

    def lost(policy: str, frame: str, **settings: object) -> tuple[float, int, int]:
        _, carried, config = traffic(policy, 2000, frame=frame, **settings)
        sent = sum(len(slot.lengths) for slot in carried)
        return 1.0 - sum(len(slot.heard) for slot in carried) / sent, sent, config.frame_length

    def gain(frame: str) -> float:
        sensing, sent, length = lost("csma", frame, options={"csma.period_ms": 15.0, "csma.window_ms": 15.0})
        load = sent * Airtime().on_air_ns(length) / (2000 * 2_000_000)
        return lost("pure-aloha", frame, options={"pure-aloha.load": load})[0] / sensing

    assert gain("extended") > 1.15
    assert gain("paper") < 1.05


def test_the_radio_of_an_agent_that_is_switched_off_sends_nothing() -> None:
    options = {"csma.period_ms": 15.0, "csma.window_ms": 60.0}
    air, _, _ = traffic("csma", 0, frame="extended", options=options)
    slots = iter(range(2000))
    while (3, 1) not in air._due_ns:  # its radio listens
        air.slot(next(slots))
    air.swarm.present[3] = 0
    assert not any(4 in air.slot(next(slots)).senders for _ in range(100))
    air.swarm.present[3] = 1
    assert any(4 in air.slot(next(slots)).senders for _ in range(100))


def test_beacons_come_at_their_rate_also_behind_lines_and_two_with_one_phase_collide() -> None:
    _, carried, _ = traffic("beacons", 1000, options={"beacons.period_ms": 20.0})
    sent = sum(len(slot.lengths) for slot in carried)
    assert sent == pytest.approx(20 * 1000 * 2 / 20, rel=0.02)
    heard = [len({frame[1] for _, frame, _ in slot.heard}) for slot in carried]
    assert sum(heard[:500]) == pytest.approx(sum(heard[500:]), abs=20)  # the same ones, period after period
    # Two of three begin while the third one's frame is on the line: they wait, and meet on the air.
    flown = []
    for radio in ("plain", "crazyflie"):
        config = SwarmConfig(agents=12, policy="beacons", slot_ms=2, seed=4, frame="extended")
        channel = ChannelConfig(agents=12, slot_ns=config.slot_ns, seed=4, radio=radio)
        air = UnslottedTraffic(make_swarm(config), Channel(channel))
        carried = [air.slot(slot) for slot in range(1000)]
        flown.append((sum(len(slot.lengths) for slot in carried), sum(len(slot.heard) for slot in carried)))
    (sent, heard), (sent_behind, heard_behind) = flown
    assert sent == sent_behind
    assert 0 < heard_behind < heard


def test_the_token_ring_takes_as_long_as_its_packets_and_survives_losses() -> None:
    """A turn: 19 frames and acknowledgements, TOKEN, RTS, CTS; each is turned to, sent, and carried to and from it."""
    air, carried, config = traffic("dtr", 1000)
    airtime, links_ns = Airtime(), 300_000 + ChannelConfig(agents=20).link_delay_ns
    frame_ns, short_ns = (airtime.total_ns(5 + length) + links_ns for length in (config.frame_length, 0))
    turn_ns = 19 * (frame_ns + short_ns) + 3 * short_ns
    heard = [(frame[1], mask) for slot in carried for _, frame, mask in slot.heard]
    assert len(heard) == pytest.approx(19 * 1000 * config.slot_ns / turn_ns, abs=19)
    assert all(mask.sum() == 1 for _, mask in heard)
    everybody_else = [mask.argmax() for _, mask in heard[:19]]
    assert sorted(everybody_else) == list(range(1, 20))
    assert not any(slot.outcome == COLLISION for slot in carried)
    air.swarm.present[7] = 0
    after = [air.slot(slot) for slot in range(1000, 1400)]
    # Frames are sent to it again and again.
    assert {int(mask.argmax()) for slot in after[200:] for _, _, mask in slot.heard} == {7}
    assert sum(len(slot.lengths) for slot in after[200:]) == pytest.approx(20, abs=1)  # one agent, every 20 ms
    # Each packet crosses the line to its sender's radio, the air, and the line from the radio of who answers.
    settings = {"agents": 20, "policy": "dtr", "seed": 3, "options": {"dtr.react_ms": 0.0}}
    config = SwarmConfig(**settings)
    channel = ChannelConfig(agents=20, slot_ns=config.slot_ns, radio="crazyflie")
    air, airtime = UnslottedTraffic(make_swarm(config), Channel(channel)), channel.airtime
    frame_ns, short_ns = (
        airtime.to_radio_ns(length) + airtime.total_ns(length) + airtime.from_radio_ns(length)
        for length in (5 + config.frame_length, 5)
    )
    turn_ns = 19 * (frame_ns + short_ns) + 3 * short_ns
    heard = sum(len(air.slot(slot).heard) for slot in range(1000))
    assert heard == pytest.approx(19 * 1000 * config.slot_ns / turn_ns, abs=19)
    config = SwarmConfig(agents=4, policy="dtr", seed=5, slot_ms=2)
    air = UnslottedTraffic(make_swarm(config), Channel(ChannelConfig(agents=4, slot_ns=2_000_000, seed=5, loss=0.3)))
    late = [{int(frame[1]) for _, frame, _ in air.slot(slot).heard} for slot in range(4000)][3000:]
    assert set().union(*late) == {1, 2, 3, 4}
    with pytest.raises(ConfigError, match="agents: got 21; allowed: 2 to 20 with policy dtr"):
        make_swarm(SwarmConfig(agents=21, policy="dtr"))


def test_event_triggered_tdma_is_silent_without_news_and_sotdma_finds_slots_of_its_own() -> None:
    busy, quiet = (steady(policy, 12, 4).outcome for policy in ("tdma", "event-tdma"))
    assert busy.idle == 0
    assert quiet.idle > 0.4 * quiet.slots
    assert quiet.collisions == 0
    flown = dtsa.simulate(agents=12, policy="event-tdma", slot_ms=2, options={"event-tdma.error_m": 0.02}).summary
    assert flown["completed"]
    assert flown["channel_load"] < 0.8 * dtsa.simulate(agents=12, policy="tdma", slot_ms=2).summary["channel_load"]
    run = steady("sotdma", 12, 12, slots=3000)
    late = [slot for slot in run.outcome.collision_slots if slot >= 1500]
    assert len(late) < 0.05 * 1500
    assert run.outcome.age < 2 * 12


def test_radios_that_listen_before_they_talk_need_no_leases() -> None:
    """Without loss all have the same ranks; with it a few do that should not."""
    sense, lease = (steady(policy, 12, 2, frame="extended").outcome for policy in ("sense", "lease"))
    assert 0.5 < sense.age < lease.age
    assert sense.collisions <= 1  # of two that have just set out
    lossy = steady("sense", 12, 6, 0.3, frame="extended").outcome
    assert 0 < lossy.collisions < 0.02 * lossy.slots
    assert lossy.age < steady("lease", 12, 6, 0.3).outcome.age


def test_every_scheme_flies_and_the_same_seed_gives_the_same_flight() -> None:
    for name in sorted(POLICIES.plug_ins()):
        if not POLICIES.factory(name).__module__.startswith("dtsa_bench.simulation.schemes"):
            continue
        flights = [dtsa.simulate(agents=4, policy=name, slot_ms=2, loss=0.1, seed=7, timeout_s=3) for _ in range(2)]
        assert flights[0].summary["slots"]["total"] > 500, name
        first, second = ({**flight.summary, "wall_time_s": 0, "realtime_factor": 0} for flight in flights)
        assert first == second, name


def test_nodes_refuse_what_nodes_cannot_do() -> None:
    for policy, options, mode in (
        ("beacons", FlightOptions(processes=1), "lockstep"),
        ("csma", FlightOptions(), "realtime"),
        ("dtr", FlightOptions(), "realtime"),
        ("genie-age", FlightOptions(processes=2), "lockstep"),
        ("genie-age", FlightOptions(processes=1), "realtime"),
    ):
        with pytest.raises(ConfigError, match="policy"):
            check_options(RunConfig(swarm=SwarmConfig(agents=4, policy=policy), mode=mode), options)
    check_options(RunConfig(swarm=SwarmConfig(agents=4, policy="genie-age")), FlightOptions(processes=1))
    with pytest.raises(ConfigError, match="policy: got 'pure-aloha'; allowed: a policy with slots"):
        AgentGroup(make_swarm(SwarmConfig(agents=4, policy="pure-aloha")))
    mission = RunConfig(swarm=SwarmConfig(agents=4, policy="beacons"), mode="realtime")
    settings = SwarmSettings((), GroundStationSettings())
    with pytest.raises(ConfigError, match="policy: got 'beacons'; allowed: a policy with slots"):
        fly_crazyflies(mission, settings, Path("swarm.yaml"), Path("out"), FlightOptions(), Stop())
    with pytest.raises(ConfigError, match="policy"):
        make_swarm(SwarmConfig(agents=4, policy="genie-age"), local=[1, 2])


def test_wrong_answers_of_such_plug_ins_and_missing_methods_are_named() -> None:
    class Base:
        options = ("to",)

        def __init__(self, config: SwarmConfig, agent: int) -> None:
            self.to = int(config.options.get("chatty.to", 0.0))

    class Chatty(Base):
        def wake(self, table: object, now_ns: int, radio: Any) -> int:
            radio.send(bytes(250), self.to)
            return now_ns + 1

        def received(self, table: object, now_ns: int, sender: int, note: bytes) -> int:
            return 0

    dtsa.register("policy", "chatty", Chatty)
    dtsa.register("policy", "wrong-genie", type("Wrong", (Base,), {"senders": lambda self, swarm, slot: [5]}))
    dtsa.register("policy", "stuck", type("Stuck", (Base,), {"wake": lambda self, table, now_ns, radio: now_ns}))
    for policy, options, said in (
        ("chatty", {}, "wake: sent 269 bytes; allowed: 1 to 255"),
        ("chatty", {"chatty.to": 5.0}, r"wake: sent .*, 5\); allowed: bytes, to 0 \(all\) to 4"),
        ("wrong-genie", {}, "senders: chose agent 5 in slot 0; allowed: 1 to 4"),
        ("stuck", {}, "wake: gave 0 ns"),
    ):
        with pytest.raises(PluginError, match=f"policy {policy}, {said}"):
            simulate(RunConfig(swarm=SwarmConfig(agents=4, policy=policy, options=options)))

    class Deaf:
        port = ("send", "busy")

        def wake(self, table: object, now_ns: int, radio: Any) -> int:
            return now_ns + 1

    with pytest.raises(ConfigError, match=r"deaf\.port.*'busy' with the methods sensed and sent"):
        dtsa.register("policy", "deaf", Deaf)
