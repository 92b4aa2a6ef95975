"""Numbers that documents quote and code has are those of the code; one that changes there changes on its page."""

from __future__ import annotations

import inspect
import re
from pathlib import Path

import pytest

pytest.importorskip("dtsa_msgs.msg")

from dtsa_dev.soak import mutants

from dtsa_agent import plugin_watch
from dtsa_agent.air import datagram, slots
from dtsa_agent.core import SwarmConfig
from dtsa_agent.core.agents import authentication, pacing
from dtsa_agent.core.reference import alignment, frame, frame_extended
from dtsa_agent.core.reference.lease import memory
from dtsa_agent.core.registry import MAX_OWN_BYTES
from dtsa_agent.crazyflie.links import delivery, emergency_radio, link
from dtsa_agent.crazyflie.motion import paths, steering, trajectories
from dtsa_agent.crazyflie.node import agents_node, bridge, bridge_node
from dtsa_agent.crazyflie.positions import motion_capture
from dtsa_agent.crazyflie.safety import landing_places, rules
from dtsa_agent.crazyflie.settings import radio_budget
from dtsa_agent.crazyflie.vehicle import landing
from dtsa_agent.ros import membership, odometry_vehicle, realtime, reporter
from dtsa_agent.ros.common.graph import names
from dtsa_agent.ros.common.process import loop, runs
from dtsa_agent.ros.common.wire import checks, covariances, intake
from dtsa_bench.crazyflies.missions import ground_station, mission_recorder, moves_to_places, places
from dtsa_bench.crazyflies.simulated import ports, supervisor
from dtsa_bench.crazyflies.simulated.fleet_config import FleetConfig
from dtsa_bench.crazyflies.simulated.radio import receiver
from dtsa_bench.flights import agent_parameters, clock_statistics, ending
from dtsa_bench.pages.demo import live
from dtsa_bench.pages.view import moments, network_listener, server, track, vehicles
from dtsa_bench.recordings.bag import metadata, writer
from dtsa_bench.recordings.merge import agent_recorder, json_bag, merge
from dtsa_bench.runs import hearing
from dtsa_bench.runs.config import RunLimits
from dtsa_channel_sim.model import airtime, medium
from dtsa_channel_sim.ros import attendance, live_air, pace, realtime_channel, roll_call, roster
from dtsa_channel_sim.ros.answer_limits import AnswerLimits

ROOT = Path(__file__).resolve().parents[4]
if not (ROOT / "tools" / "dtsa").exists():
    pytest.skip("not in the source tree", allow_module_level=True)
WORDS = ("no", "one", "two", "three", "four", "five", "six", "seven", "eight", "nine", "ten")
SPANS = {0.5: "half a second", 1.0: "a second", 1800.0: "half an hour"}
ALIGN = {name: given.default for name, given in inspect.signature(alignment.ClockAligner).parameters.items()}


def seconds(value_ns: float) -> str:
    return f"{value_ns / 1e9:g}"


def ms(value_ns: float) -> str:
    return f"{value_ns / 1e6:g} ms"


def span(value_s: float) -> str:
    return SPANS[value_s]


def word(value: float) -> str:
    """A whole number as a word."""
    assert value == int(value)
    return WORDS[int(value)]


def often(period_s: float) -> str:
    """How often a second, as a word."""
    return "twice" if period_s == 0.5 else f"{word(round(1 / period_s, 6))} times"


def constant(path: str, name: str) -> int:
    """A number in a source that is not Python, or no module of ours: the one that a name is given."""
    found = re.search(rf"\b{name} = (\d+)", (ROOT / path).read_text(encoding="utf-8"))
    assert found, f"{path}: {name}"
    return int(found[1])


PYTHONS = "3.{} to 3.{}".format(*re.findall(r"\(3, (\d+)\)", (ROOT / "tools" / "dtsa").read_text(encoding="utf-8")))
VIEW, PORT = "src/dtsa_bench/dtsa_bench/pages/view/assets", "src/dtsa_agent/dtsa_agent/air/_hearing/port.h"

# What pages say with numbers that code has.
FIGURES: dict[str, list[str]] = {
    "docs/explanation/real-time.md": [
        f"more than {span(pace._BEHIND_NS / 1e9)} behind for {seconds(pace._TOO_LONG_NS)} seconds, the flight is ended",
        f"takes in {realtime_channel._FRAMES} frames and {word(realtime_channel._REPORTS)} reports",
        f"for {word(pace._STALL_SLOTS)} slots and {ms(pace._STALL_NS)} at least",
        f"or {span(realtime_channel._PATIENCE_NS / 1e9)} "
        f"({word(realtime_channel._PATIENCE_SLOTS)} slots, if that is more) after its end",
        f"A frame is settled {live_air._GRACE:g} slots after it has left the air",
        f"at most {pacing.LEAD:g} slots ahead",
        f"until {pacing.LATEST_LEAD:g} slots before the start",
        f"until {realtime._LATEST:g} slots, at most {ms(realtime._LATEST_NS)}, after it",
        f"of each process {often(reporter._PERIOD_NS / 1e9)} a second",
        f"If that is more than {realtime_channel._TIGHT:g}",
        f"for up to {word(roll_call._SETTLED_S)} seconds",
        f"half the median of {word(ALIGN['receptions'])} such offsets, ignoring those beyond {ms(ALIGN['limit_ns'])}",
        f"When {word(realtime._DOUBTS)} frames in a row do not fit",
        f"(nice {agent_parameters.AGENTS_NICE}, parameter",
        f"(nice {agent_parameters.CHANNEL_NICE})",
    ],
    "docs/how-to/real-time.md": [
        f"an agent that hangs after {attendance.LOST_AFTER_S:g} s",
        f"{word(ending._FACTOR)} times `--timeout-s`, at least {ending._LEAST_S:g}",
        "after (K M + 1) N slots at the latest",  # RealtimeNode._ended; test_nodes leaves a flight so
    ],
    "docs/reference/metrics.md": [
        f"frames that left within {ms(clock_statistics.ON_TIME_NS)} of the swarm's common time",
        f"largest of the last {clock_statistics._END} slots",
        f"closer than `collision_m` ({RunLimits().collision_m:g} m)",
        f"within `r_min` ({SwarmConfig().r_min:g} m)",
    ],
    "docs/how-to/security.md": [
        f"ends with a {authentication.TAG_LENGTH}-byte code",
        f"once in {256**authentication.TAG_LENGTH:.1e} tries".replace("e+0", "e"),
        f"{authentication.MIN_KEY} to {authentication.MAX_KEY} bytes",
        f"a random number of {runs.MOST_SESSIONS.bit_length() - 1} bits",
        f"SHA-256 of {runs._PROOF_BYTES} secret bytes",
        f"processes of another run that stay for {roster._LEFT_OVER_S:g} s",
        f"after {checks._SILENT_S:g} s without any message the next number is taken",
        f"(a line every {intake._LOG_S:g} s at most)",
        f"without any for {agents_node.STALE_S:g} s a vehicle gets no",
        f"nobody publishes slots any more for {membership._GONE_S:g} s",
    ],
    "docs/reference/bag.md": [
        f"metadata version {metadata.VERSION}",
        f"Slot 0 starts at {seconds(names.TIME_ZERO_NS)} s",
        f"at `{seconds(names.TIME_ZERO_NS)} s + i * slot length`",
        f"nothing claimed ({covariances.UNKNOWN:.0e})".replace("e+0", "e"),
        f"to the operating system {often(writer.FLUSH_S)} a second",
    ],
    "docs/how-to/view.md": [
        f"last {track.MOST_MOMENTS:,} moments",
        f"last {constant(f'{VIEW}/run.js', 'MOMENTS'):,} moments",
        f"positions {moments.PLACES_HZ:g} times a simulated second",
        f"at most {server.RATE_HZ:g} times a second of wall time",
        f"the last {moments.MOST_FRAMES} frames are kept",
        f"swarms of more than {moments.BELIEFS} agents",
        f"more than {constant(f'{VIEW}/bodies.js', 'SOFTWARE_AGENTS')} agents, the scene draws",
        f"within {word(constant(f'{VIEW}/crazyflies.js', 'SURE_MS') / 1000)} seconds",
        f"has not told for {word(vehicles._SILENT_S)} seconds is called silent",
        f"after {word(network_listener._SILENCE_NS / 1e9)} seconds in which no other came",
        f"carried out by the flight itself {often(loop.HOUSEKEEPING_S)} a second at most",
        f"(`collision_m`, {RunLimits().collision_m:g} m across)",
    ],
    "docs/reference/network.md": [
        f"| {datagram.HEADER}-.. | the frame",
        f"{word(datagram.NETWORK.peers)} of those that its sender hears",
        f"in {datagram._UNIT_NS / 1000:g} us, little-endian",
        f"median offset of {word(ALIGN['receptions'])} frames. When {word(slots._DOUBTS)} in a row "
        f"are off by more than {ms(ALIGN['limit_ns'])}",
        f"It wakes once a slot, {pacing.LEAD:g} slots before the next one starts",
        f"{pacing.BETWEEN:g} slots ahead at the latest",
        f"takes in {constant(PORT, 'BURST')} datagrams at most",
        f"more than {pacing.MOST_EARLY} frames of slots that are still to come",
        f"at most {agent_recorder._MOST_REFUSED / json_bag._FLUSH_S:g} a second",
        f"largest of the last {merge._END}",
    ],
    "docs/how-to/crazyflie-missions.md": [
        f"For {ground_station.STOPPING_S[0]:g} to {ground_station.STOPPING_S[1]:g} s the agents",
        f"{1 / mission_recorder.PERIOD_S:g} times a second the latest of commands",
        f"more than {places.PLACE_M:g} m from where it would begin",
        f"two closer than {places.APART_M:g} m to each other",
        f"straight where {moves_to_places.CLEAR_M:g} m are clear, else {moves_to_places.LAYER_M:g} m above",
        f"from UDP port {ports.FIRST} on",
    ],
    "docs/reference/crazyflie.md": [
        f"more than {motion_capture.ROOM_MARGIN_M:g} m outside the geofence",
        f"{motion_capture.MOVED_AGAIN} poses that agree with each other",
        f"zero velocity for {span(rules.ESTIMATE_HOLD_S)}, then the vehicle sinks at {landing.SINK_MPS:g} m/s",
        f"the watchdog ({radio_budget.WATCHDOG_HZ} Hz), orders ({radio_budget.ORDERS_HZ} Hz)",
        f"{radio_budget.TURN_S * 1e3:g} ms for each of the two radios to turn, "
        f"and {radio_budget.USB_S * 1e3:g} ms on USB",
        f"largest speed is {paths.PEAK:.2f} times the mean one",
        f"The rules are applied {1 / bridge.TICK_S:g} times a second",
        f"ordered blindly, {word(landing.BLIND_REPEATS + 1)} times",
        f"broadcast, {emergency_radio.ROUNDS} times within {span(emergency_radio.ROUNDS * emergency_radio.PAUSE_S)}",
        f"(horizontally nearer than {landing_places.BELOW_M:g} m)",
        f"that is {landing_places.CLEAR_M:g} m from all others",
        f"is waited for, for {landing_places.PASSES_S:g} s",
        f"after {landing_places.PATIENCE_S:g} s it sinks where it is",
        f"levels out {supervisor.LEVEL_OUT_S:g} s after the last streamed command",
        f"stops its motors for good at {supervisor.SHUTDOWN_S:g} s",
        f"packet, of which there are {word(radio_budget.WATCHDOG_HZ)} a second",
        f"is sent again every {delivery.REPEAT_S:g} s until the firmware has answered it",
        f"anew {link.LOG_ORDER_S:g} s after it hears the Crazyflie again",
        f"after {link.REOPEN_S[0]:g} s, {2 * link.REOPEN_S[0]:g} s, ... {link.REOPEN_S[1]:g} s",
    ],
    "docs/how-to/crazyflie.md": [
        f"cannot be steered lower than {steering.FLOOR_M:g} m",
        f"begin more than {trajectories.START_M:g} m from where it is",
        f"status {bridge_node.STATUS_HZ:g} times a second",
        f"(noted below {FleetConfig().collision_m:g} m, both fall below {FleetConfig().crash_m:g} m)",
        f"the queue of {receiver.QUEUE}, the log that ends after {span(receiver.ACTIVITY_S)} of silence",
    ],
    "docs/how-to/vehicles.md": [
        f"(at most {odometry_vehicle._HOLD_MPS:g} m/s)",
        f"({odometry_vehicle._SLACK_M:g} m and `fastest_mps` times the time in between)",
        f"the velocity 0 {word(odometry_vehicle._STOPS)} times within {odometry_vehicle._STOPS_S:g} s",
    ],
    "docs/reference/channel.md": [
        f"has {airtime.OVERHEAD_BITS} + 8 (n + {airtime.HEADER_BYTES}) bits",
        f"distances below {medium._NEAREST_M * 100:g} cm count as {medium._NEAREST_M * 100:g} cm",
        f"every {ALIGN['receptions']} receptions",
        f"offsets beyond {ms(ALIGN['limit_ns'])} are not trusted",
    ],
    "docs/reference/protocol.md": [
        f"Profile `paper` (0), {frame.LENGTHS[frame.PROFILE_PAPER]} bytes",
        f"with intent (1), {frame.LENGTHS[frame.PROFILE_PAPER_INTENT]} bytes",
        f"Profile `extended` (2), {frame.EXTENDED_LENGTH} bytes",
        f"the first {frame.EXTENDED_HEAD} bytes hold",
        f"sender's id, 1 to {frame.EXTENDED_SENDER_MAX}",
        f"c_s, 0 to {frame_extended.C_S_MAX}; {frame_extended.LEAVING}: the sender leaves",
        f"sections of {frame_extended.SECTION_BYTES} bytes",
        f"age in slots (7 bits, 1 to {frame_extended.GOSSIP_AGE_MAX})",
        f"leases within {frame_extended.RELAY_REACH} slots",
        f"at most {frame_extended.RELAY_IDS} lessees ({frame_extended.OPEN} OPEN)",
        f"turns {frame_extended.RELAY_REACH + 1} to {frame_extended.FAR_REACH} slots ahead",
        f"An agent is **deaf** when its own silence is above {memory.DEAF}",
        f"missed fewer than {memory.MISSED} expected turns",
    ],
    "docs/reference/plug-ins.md": [
        f"a call that has not returned after {plugin_watch.LIMIT_S:g} s (`{plugin_watch.VARIABLE}`",
        f"n bytes of its own, up to {MAX_OWN_BYTES}, follow each frame: {frame.LENGTHS[frame.PROFILE_PAPER]} or "
        f"{frame.LENGTHS[frame.PROFILE_PAPER_INTENT]} bytes without or with intent",
        f"the tag; {frame.FRAME_MAX} in all",
    ],
    "docs/how-to/fly.md": [
        f"once {hearing._ROUNDS} N slots have passed",
        f"did not answer slot 120 within {AnswerLimits().answer_s:g} s",
    ],
    "docs/how-to/demo.md": [
        f"is killed (SIGKILL) after {live.KILL_AFTER_S:g} s",
    ],
    "docs/evidence/faults.md": [
        f"do not end within {word(mutants._LIMIT_S / 60)} minutes",
    ],
    "docs/how-to/install.md": [
        f"Python {PYTHONS} with `venv`",
    ],
    "CONTRIBUTING.md": [
        f"Needed from the system: Python {PYTHONS}",
        f"for Python {PYTHONS}",
        f"for {span(constant('tools/machine/prepare.py', 'PATIENCE_S'))} at most",
    ],
}


def text_of(page: str) -> str:
    """A page in one line.

    :param page: its path in the checkout.
    """
    return " ".join((ROOT / page).read_text(encoding="utf-8").split())


@pytest.mark.parametrize("page", FIGURES)
def test_numbers_in_documents_are_those_of_the_code(page: str) -> None:
    text = text_of(page)
    assert not [figure for figure in FIGURES[page] if figure not in text]


@pytest.mark.parametrize("name", ["explanation/real-time.md", "reference/network.md", "how-to/view.md"])
def test_what_is_too_long_a_stand_still_is_what_pages_say(name: str) -> None:
    assert "max(500, 3 M N) slots" in text_of(f"docs/{name}")
    for agents, anchor_every in ((2, 5), (40, 5), (70, 2)):
        config = SwarmConfig(agents=agents, policy="lease", anchor_every=anchor_every)
        assert pacing.too_long_ns(config) == max(500, 3 * anchor_every * agents) * config.slot_ns
