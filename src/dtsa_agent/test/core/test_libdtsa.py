"""The public header of libdtsa: one agent in the caller's memory is an agent of a swarm, bit for bit."""

from __future__ import annotations

import ctypes
import re
from ctypes import POINTER, byref, c_char_p, c_double, c_int, c_int64, c_long, c_size_t, c_uint8, c_uint32, c_uint64
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from dtsa_agent.core import Swarm, SwarmConfig, _kernel, binding
from dtsa_agent.core.agents.authentication import Authenticator
from dtsa_agent.core.reference.alignment import ClockAligner
from dtsa_agent.core.reference.timebase import TimeBase
from dtsa_agent.core.settings import flight_models

HEADER = Path(flight_models.__file__).parents[2] / "libdtsa" / "include" / "dtsa.h"
LIB = ctypes.CDLL(str(_kernel.__file__))
DOUBLES = POINTER(c_double)
Three = c_double * 3


class Avoid(ctypes.Structure):
    _fields_ = [(name, c_double) for name in flight_models.flight_model("orca").avoider.to_dict()]


class Lease(ctypes.Structure):
    _fields_ = [
        ("anchor_every", c_int), ("open_every", c_int), ("adoption", c_int), ("depth_rate", c_double),
        ("share", c_double), ("patience", c_int64), ("main_every", c_int),
    ]  # fmt: skip


class Config(ctypes.Structure):
    _fields_ = [
        ("agents", c_int), ("slot_s", c_double), ("steps", c_int),
        *((name, c_int) for name in ("policy", "estimator", "avoider", "selection", "profile")),
        ("epsilon", c_double), ("age_cap", c_double), ("boot_round", c_int), ("return_every", c_int),
        ("r_min", c_double), ("c_r", c_int), ("targets_known", c_int), ("gossip", c_int), ("position_step", c_double),
        ("key", c_uint64), ("avoid", Avoid), ("lease", Lease), ("start", DOUBLES), ("target", DOUBLES),
        ("decay", DOUBLES), ("decay_len", c_int),
    ]  # fmt: skip


class Decision(ctypes.Structure):
    _fields_ = [
        ("chosen", c_int), ("reason", c_int), ("sends", c_int), ("score", c_double), ("digest", c_uint32),
    ]  # fmt: skip


class Aligner(ctypes.Structure):
    _fields_ = [
        ("receptions", c_int), ("share", ctypes.c_int32), ("limit_ns", c_int64), ("count", c_int),
        ("offsets", c_int64 * 15), *((n, c_uint32) for n in ("corrections", "ignored", "ignored_in_a_row")),
    ]  # fmt: skip


class Base(ctypes.Structure):
    _fields_ = [
        *((name, c_int64) for name in ("slot_ns", "round_ns", "wait_ns", "deadline_ns", "origin_ns")),
        ("state", c_int), ("restarts", c_uint32), ("aligner", Aligner),
    ]  # fmt: skip


LIB.dtsa_agent_bytes.restype = c_size_t
LIB.dtsa_agent_start.restype = ctypes.c_void_p
LIB.dtsa_agent_start.argtypes = [ctypes.c_void_p, c_size_t, POINTER(Config), c_int]
LIB.dtsa_agent_decision.restype = Decision
LIB.dtsa_config_fault.restype = c_char_p
for _name, _more in (
    ("restart", ()), ("leave", ()), ("switch", (c_int,)), ("set_state", (Three, Three)), ("set_goal", (Three, c_int)),
    ("slot", (c_int64, c_uint8 * 60)), ("decision", ()), ("hear", (c_int64, c_char_p, c_long)), ("end", (c_int64,)),
    ("command", (c_int64, c_int, Three)), ("is_on", ()),
):  # fmt: skip
    getattr(LIB, f"dtsa_agent_{_name}").argtypes = [ctypes.c_void_p, *_more]
for _name in ("start", "slot", "slot_start"):
    getattr(LIB, f"dtsa_timebase_{_name}").restype = c_int64
LIB.dtsa_timebase_init.argtypes = [POINTER(Base), c_int, c_int, c_int64, c_int, c_uint64]
LIB.dtsa_timebase_hear.argtypes = [POINTER(Base), c_int64, c_int64]
for _name in ("start", "wake", "slot", "slot_start"):
    getattr(LIB, f"dtsa_timebase_{_name}").argtypes = [POINTER(Base), c_int64]
LIB.dtsa_open.restype = c_long
LIB.dtsa_open.argtypes = [c_char_p, c_int, c_uint64, c_int64, c_int, c_char_p, c_long]


def config_of(swarm: Swarm) -> Config:
    """The settings of a swarm as the header's structure."""
    given: dict[str, Any] = swarm._parameters(len(swarm.ids))
    made = Config(avoid=Avoid(), lease=Lease())
    for part in (made, made.avoid, made.lease):
        for name, kind in part._fields_:
            if name in given:
                setattr(part, name, given[name] % 2**64 if kind is c_uint64 else given[name])
    made.start, made.target, made.decay = (
        np.ascontiguousarray(a).ctypes.data_as(DOUBLES) for a in (swarm._start, swarm.known_goal, swarm._decay)
    )
    return made


def start(config: Config, ids: range) -> list[tuple[Any, int]]:
    size = LIB.dtsa_agent_bytes(byref(config))
    memories = [(c_double * (size // 8))() for _ in ids]
    return [
        (m, LIB.dtsa_agent_start(ctypes.addressof(m), size, byref(config), i))
        for m, i in zip(memories, ids, strict=True)
    ]


@pytest.mark.parametrize(
    ("policy", "estimator", "avoider"),
    [("tdma", "hold", "potential"), ("dtsa", "linear", "orca"), ("age", "intent", "bvc"), ("aloha", "linear", "none"),
     ("lease", "intent", "orca")],
)  # fmt: skip
def test_agents_of_the_library_fly_what_a_swarm_flies(policy: str, estimator: str, avoider: str) -> None:
    settings = SwarmConfig(agents=6, moving=4, policy=policy, estimator=estimator, avoider=avoider, seed=2)
    swarm, draw = Swarm(settings), np.random.default_rng(7)
    config = config_of(swarm)
    agents = start(config, range(1, 7))
    for slot in range(400):
        if slot == 150:
            for part, (_, agent) in enumerate(agents[:2]):
                swarm.restart(part)
                LIB.dtsa_agent_restart(agent)
        if slot == 200 and swarm.config.policy_row.says_leaving:
            swarm.leave(4)
            LIB.dtsa_agent_leave(agents[4][1])
        senders = swarm.begin(slot)
        for index, (_, agent) in enumerate(agents):
            position, velocity = Three(*swarm.position[:, index]), Three(*swarm.velocity[:, index])
            LIB.dtsa_agent_set_state(agent, position, velocity)
            LIB.dtsa_agent_set_goal(agent, Three(*swarm.goal[:, index]), int(swarm.final[index]))
            frame = (c_uint8 * 60)()
            length = LIB.dtsa_agent_slot(agent, slot, frame)
            assert bytes(frame[:length]) == swarm.frame(index)
            decided = LIB.dtsa_agent_decision(agent)
            assert (decided.chosen, decided.reason) == (swarm.chosen[index], swarm.reason[index])
            assert (decided.digest, decided.score) == (swarm.digest[index], swarm.score[index])
        for index, (_, agent) in enumerate(agents):
            command = Three()
            LIB.dtsa_agent_command(agent, slot, 0, command)
            swarm.steer(slot, 0)
            assert tuple(command) == tuple(swarm.command[:, index])
        swarm.fly(slot)
        for sender in senders:
            data, mask = swarm.frame(sender), (draw.random(6) > 0.2).astype(np.uint8)
            swarm.hear(slot, data, mask)
            for index, (_, agent) in enumerate(agents):
                if mask[index]:
                    LIB.dtsa_agent_hear(agent, slot, data, len(data))
        swarm.end(slot)
        for index, (_, agent) in enumerate(agents):
            LIB.dtsa_agent_end(agent, slot)
            assert LIB.dtsa_agent_is_on(agent) == bool(swarm.present[index])


def test_an_agent_does_not_start_where_it_cannot() -> None:
    config = config_of(Swarm(SwarmConfig(agents=6, policy="lease")))
    size = LIB.dtsa_agent_bytes(byref(config))
    memory = (c_double * (size // 8 + 1))()
    at = ctypes.addressof(memory)
    assert LIB.dtsa_agent_start(at, size, byref(config), 6)
    for place, room, agent in ((at, size - 8, 1), (at + 4, size, 1), (at, size, 0), (at, size, 7), (None, size, 1)):
        assert not LIB.dtsa_agent_start(place, room, byref(config), agent)
    for field, value in (("agents", 0), ("agents", 255), ("policy", 6), ("profile", 0), ("c_r", 0), ("slot_s", 0.0)):
        bad = config_of(Swarm(SwarmConfig(agents=6, policy="lease")))
        setattr(bad, field, value)
        assert LIB.dtsa_config_fault(byref(bad)).decode() == field
        assert LIB.dtsa_agent_bytes(byref(bad)) == 0


def test_the_header_says_its_version() -> None:
    version = re.search(r"#define DTSA_VERSION (\d+)", HEADER.read_text())
    assert version
    assert LIB.dtsa_version() == int(version[1]) == _kernel.VERSION


def test_one_compiled_file_serves_every_python() -> None:
    assert Path(str(_kernel.__file__)).name == "_kernel.abi3.so"


SCALARS = {"int": "i", "double": "d", "int64_t": "q", "uint64_t": "Q"}
ITEMS = {
    "double": "f8", "int64_t": "i8", "uint64_t": "u8", "int32_t": "i4", "uint32_t": "u4", "uint16_t": "u2",
    "uint8_t": "u1", "metrics_sums": "i8",
}  # fmt: skip


def declared(structure: str, headers: str) -> list[tuple[str, str]]:
    """Name and type of each field of a structure, those of structures in it in their place, as binding.py has them."""
    body = re.search(rf"typedef struct (?:{structure} )?\{{((?:(?!typedef).)*?)\}} {structure};", headers, re.DOTALL)
    assert body, structure
    found = []
    for line in body[1].split(";"):
        kind, names = re.fullmatch(r"\s*(?:(?:const )?(\w+) (.*))?\s*", " ".join(line.split())).groups()
        for name in names.split(", ") if names else ():
            if name.startswith("*"):
                found.append((name[1:], ITEMS.get(kind, kind)))
            else:
                found += [(name, SCALARS[kind])] if kind in SCALARS else declared(kind, headers)
    return found


@pytest.mark.parametrize(
    ("layout", "structure"),
    [(binding.SWARM, "swarm"), (binding.METRICS, "metrics"), (binding.AVOID, "dtsa_avoid_params")],
)
def test_images_have_the_fields_of_their_headers(layout: binding.Layout, structure: str) -> None:
    sources = (HEADER, *(HEADER.parents[2] / "libdtsa_sim" / f"{name}.h" for name in ("swarm", "metrics", "vehicle")))
    text = re.sub(r"/\*.*?\*/", "", "".join(source.read_text() for source in sources), flags=re.DOTALL)
    fields = declared(structure, text)
    if structure == "swarm":
        fields = fields[: [name for name, _ in fields].index("tables")]  # its own part is none of Python's business
    assert [(name, kind.removesuffix("0q")) for name, kind, _ in layout.fields] == fields
    with pytest.raises(ImportError, match="build dtsa_agent again"):
        binding.Layout(layout.fields, 0)


def test_arrays_that_do_not_fit_are_refused() -> None:
    good = {"path": np.zeros(2), "last_position": np.zeros((3, 2)), "target": np.zeros((3, 2))}
    good |= {"moving": np.zeros(2, np.uint8), "sums": np.zeros(12, np.int64), "gone": np.zeros(2, np.uint8)}
    good |= {"goal": np.zeros((3, 2)), "woken": np.zeros(2, np.int64), "heard": np.zeros(2, np.uint8)}
    good |= {"delays": np.zeros(256, np.int64)}
    sizes = {"n": 2, "d": 256, "s": 12}
    values = {"n": 2, "news_from": 0, "collision_m": 0.1, "r_min": 0.1}
    assert len(binding.METRICS.image(values, good, sizes)) == _kernel.METRICS_IMAGE
    frozen = np.zeros(2)
    frozen.flags.writeable = False
    for bad in (np.zeros(3), np.zeros(2, np.float32), np.zeros(2, np.int64), np.zeros((2, 2))[:, 0], frozen):
        with pytest.raises(ValueError, match="path"):
            binding.METRICS.image(values, {**good, "path": bad}, sizes)
    with pytest.raises(ValueError, match="image"):
        _kernel.metrics(bytes(8), good)
    with pytest.raises(ValueError, match="agents"):
        _kernel.swarm(bytes(_kernel.SWARM_IMAGE), ())


@pytest.mark.parametrize("seed", range(4))
def test_time_bases_agree(seed: int) -> None:
    draw = np.random.default_rng(seed)
    theirs, base = TimeBase(agents=5, anchor_every=3, slot_ns=1_000_000, agent=2, seed=seed), Base()
    assert LIB.dtsa_timebase_init(byref(base), 5, 3, 1_000_000, 2, seed)
    now = int(draw.integers(10**9))
    assert LIB.dtsa_timebase_start(byref(base), now) == theirs.start(now)
    names, outcomes = ["listening", "alone", "joined"], ["aligned", "restarted", "foreign"]
    for _ in range(2000):
        now += int(draw.integers(2_000_000))
        if draw.random() < 0.3:
            assert bool(LIB.dtsa_timebase_wake(byref(base), now)) == theirs.wake(now)
        if draw.random() < 0.5:
            known = theirs.slot(now)
            slot = int(draw.integers(1000)) if known is None or draw.random() < 0.02 else known
            heard_at = now if known is None else theirs.slot_start_ns(slot) + int(draw.integers(-400_000, 400_000))
            heard_at += int(draw.integers(-(10**7), 10**7)) if draw.random() < 0.02 else 0
            assert outcomes[LIB.dtsa_timebase_hear(byref(base), slot, heard_at)] == theirs.hear(slot, heard_at)
        assert names[base.state] == theirs.state
        assert base.restarts == theirs.restarts
        if theirs.state != "listening":
            assert LIB.dtsa_timebase_slot(byref(base), now) == theirs.slot(now)
            assert LIB.dtsa_timebase_slot_start(byref(base), 77) == theirs.slot_start_ns(77)
    aligner = theirs._aligner
    assert isinstance(aligner, ClockAligner)
    assert (base.aligner.corrections, base.aligner.ignored) == (aligner.corrections, aligner.ignored)
    assert base.aligner.corrections > 0


def test_tags_are_those_of_the_authenticator() -> None:
    draw = np.random.default_rng(3)
    for length in (1, 19, 47, 48, 49, 55, 56):
        key, session, slot = (
            draw.bytes(int(draw.integers(16, 33))),
            int(draw.integers(2**63)),
            int(draw.integers(2**40)),
        )
        data = Authenticator(key, session).seal(draw.bytes(length), slot)
        sealed = LIB.dtsa_open(key, len(key), session, slot, 0, data, len(data))
        assert sealed == length
        assert LIB.dtsa_open(key, len(key), session, slot + 1, 1, data, len(data)) == length
        assert LIB.dtsa_open(key, len(key), session, slot + 1, 0, data, len(data)) == 0
        changed = bytes([data[0] ^ 1]) + data[1:]
        assert LIB.dtsa_open(key, len(key), session, slot, 1, changed, len(changed)) == 0
    assert LIB.dtsa_open(b"k" * 16, 16, 0, 0, 1, b"abcd", 4) == 0
