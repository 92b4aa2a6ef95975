"""The public header of libdtsa: one agent in the caller's memory is an agent of a swarm, bit for bit."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from dtsa_agent.core import Swarm, SwarmConfig, _kernel
from dtsa_agent.core.kernel import ffi, lib, memory

HEADER = Path(str(_kernel.__file__)).parents[1] / "libdtsa" / "include" / "dtsa.h"


def config_of(swarm: Swarm) -> Any:
    """The settings of a swarm as the header's structure; the swarm keeps what it borrows."""
    return ffi.addressof(swarm.kernel, "config")


def start(config: Any, ids: range) -> list[tuple[Any, Any]]:
    size = lib.dtsa_agent_bytes(config)
    memories = [ffi.new("double[]", size // 8) for _ in ids]
    return [(m, lib.dtsa_agent_start(m, size, config, i)) for m, i in zip(memories, ids, strict=True)]


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
                lib.dtsa_agent_restart(agent)
        if slot == 200 and swarm.config.policy_row.says_leaving:
            swarm.leave(4)
            lib.dtsa_agent_leave(agents[4][1])
        senders = swarm.begin(slot)
        for index, (_, agent) in enumerate(agents):
            lib.dtsa_agent_set_state(agent, swarm.position[:, index].tolist(), swarm.velocity[:, index].tolist())
            lib.dtsa_agent_set_goal(agent, swarm.goal[:, index].tolist(), int(swarm.final[index]))
            frame = ffi.new("uint8_t[60]")
            length = lib.dtsa_agent_slot(agent, slot, frame)
            assert bytes(frame)[:length] == swarm.frame(index)
            decided = lib.dtsa_agent_decision(agent)
            assert (decided.chosen, decided.reason) == (swarm.chosen[index], swarm.reason[index])
            assert (decided.digest, decided.score) == (swarm.digest[index], swarm.score[index])
        for index, (_, agent) in enumerate(agents):
            command = ffi.new("double[3]")
            lib.dtsa_agent_command(agent, slot, 0, command)
            swarm.steer(slot, 0)
            assert tuple(command) == tuple(swarm.command[:, index])
        swarm.fly(slot)
        for sender in senders:
            data, mask = swarm.frame(sender), (draw.random(6) > 0.2).astype(np.uint8)
            swarm.hear(slot, data, mask)
            for index, (_, agent) in enumerate(agents):
                if mask[index]:
                    lib.dtsa_agent_hear(agent, slot, data, len(data))
        swarm.end(slot)
        for index, (_, agent) in enumerate(agents):
            lib.dtsa_agent_end(agent, slot)
            assert lib.dtsa_agent_is_on(agent) == bool(swarm.present[index])


def test_an_agent_does_not_start_where_it_cannot() -> None:
    swarm = Swarm(SwarmConfig(agents=6, policy="lease"))
    config = config_of(swarm)
    size = lib.dtsa_agent_bytes(config)
    block = ffi.new("double[]", size // 8 + 1)
    odd = ffi.cast("char *", block) + 4
    assert lib.dtsa_agent_start(block, size, config, 6)
    for place, room, agent in ((block, size - 8, 1), (odd, size, 1), (block, size, 0), (block, size, 7), (0, size, 1)):
        assert not lib.dtsa_agent_start(ffi.cast("void *", place), room, config, agent)
    for field, value in (
        ("agents", 0),
        ("agents", 255),
        ("policy", lib.DTSA_POLICY_EXTERNAL + 1),
        ("profile", 0),
        ("c_r", 0),
        ("slot_s", 0.0),
    ):
        bad = ffi.new("dtsa_config *", config[0])
        setattr(bad, field, value)
        assert ffi.string(lib.dtsa_config_fault(bad)).decode() == field
        assert lib.dtsa_agent_bytes(bad) == 0


def test_the_header_says_its_version() -> None:
    version = re.search(r"#define DTSA_VERSION (\d+)", HEADER.read_text())
    assert version
    assert lib.dtsa_version() == int(version[1]) == lib.DTSA_VERSION


def test_one_compiled_file_serves_every_python() -> None:
    assert Path(str(_kernel.__file__)).name == "_kernel.abi3.so"


def test_arrays_that_do_not_fit_are_refused() -> None:
    frozen = np.zeros(2)
    frozen.flags.writeable = False
    for bad, error in ((np.zeros((2, 2))[:, 0], ValueError), (frozen, ValueError), (np.zeros(2, "f2"), KeyError)):
        with pytest.raises(error):
            memory(bad, writable=True)
