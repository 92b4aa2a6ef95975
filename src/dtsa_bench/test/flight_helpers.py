"""Recorded flights for the tests: the real core flies, a seeded channel loses frames, a bag is written."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from bag_helpers import RUN, SECOND, cdr, definition, header

from dtsa_agent.core import REASONS, Swarm
from dtsa_agent.core.settings.config import SwarmConfig
from dtsa_bench.recordings.bag.cdr import OdometryPacker
from dtsa_bench.recordings.bag.writer import BagWriter
from dtsa_bench.runs.config import RunConfig


def flight_bag(directory: Path, slots: int = 400, loss: float = 0.0, **settings: Any) -> None:
    """Fly and record.

    :param directory: where the bag is made.
    :param slots: length of the flight.
    :param loss: probability that a receiver loses a frame.
    :param settings: fields of `SwarmConfig`.
    """
    config = SwarmConfig(**settings)
    swarm = Swarm(config)
    n, slot_ns = config.agents, config.slot_ns
    random = np.random.default_rng(config.seed)
    ids = np.arange(1, n + 1, dtype=np.uint16)
    odometry = OdometryPacker([f"cf{i}/base_link" for i in ids])
    last = swarm.position.copy()
    with BagWriter(directory, RunConfig(config).to_dict()) as writer:
        channels = {
            name: writer.add_topic(f"/swarm/{name}", kind, "reliable", definition(kind))
            for name in ("transmission", "reception", "decision")
            for kind in [f"dtsa_msgs/msg/{name.capitalize()}"]
        }
        kind = "nav_msgs/msg/Odometry"
        odom = [writer.add_topic(f"/cf{i}/odom", kind, "sensor_data", definition(kind)) for i in ids]

        def answer(slot: int, start: int, data: np.ndarray) -> None:
            """Record what the agents say at the start of a slot."""
            message = cdr(
                "dtsa_msgs/msg/Transmission",
                header=header(start),
                run=RUN,
                slot=slot,
                agent=ids,
                length=np.array([len(swarm.frame(k)) if len(data) else 0 for k in range(n)], np.uint8),
                data=data,
                offset_ns=np.zeros(0, np.int64),
                chosen=swarm.chosen,
                reason=swarm.reason,
                digest=swarm.digest,
                score=swarm.score,
                steps=config.steps,
                track=(swarm.track if slot else np.repeat(last[None], config.steps, 0)).ravel(),
                velocity=swarm.velocity.ravel(),
                command=swarm.command.ravel(),
                goal=swarm.goal.ravel() if slot == 0 else np.zeros(0),
            )
            writer.write(channels["transmission"], message, start, start)

        for slot in range(slots):
            start = SECOND + slot * slot_ns
            end = start + slot_ns
            swarm.scenario.advance(slot, swarm)
            senders = swarm.begin(slot)
            frames = [swarm.frame(k) for k in senders]
            data = np.frombuffer(b"".join(frames), np.uint8)
            answer(slot, start, data)
            names = [REASONS[code] for code in sorted(set(swarm.reason.tolist()))]
            decision = cdr(
                "dtsa_msgs/msg/Decision", header=header(start), run=RUN, slot=slot, agent=ids, chosen=swarm.chosen,
                reason_name=names, reason_index=np.array([names.index(REASONS[c]) for c in swarm.reason], np.uint8),
                reason=swarm.reason, digest=swarm.digest, score=swarm.score,
            )  # fmt: skip
            swarm.fly(slot)
            heard = np.zeros((len(senders), n), np.uint8)
            if len(senders) == 1:
                heard[0] = random.random(n) >= loss
                heard[0, senders[0]] = 0
                swarm.hear(slot, frames[0], heard[0])
            swarm.end(slot)
            alone = len(senders) == 1
            writer.write(
                channels["reception"],
                cdr(
                    "dtsa_msgs/msg/Reception", header=header(end), run=RUN, slot=slot, outcome=min(2, len(senders)),
                    sender=np.array([k + 1 for k in senders], np.uint16),
                    received=np.packbits(heard, axis=1, bitorder="little").ravel(),
                    lost=np.array([n - 1 - heard[0].sum()] if alone else [0] * len(senders), np.uint16),
                    collided=np.array([0] if alone else [n - 1] * len(senders), np.uint16),
                ),
                end, end,
            )  # fmt: skip
            writer.write(channels["decision"], decision, end, start)
            for channel, message in zip(odom, odometry.pack(end, swarm.position, swarm.velocity), strict=True):
                writer.write(channel, message, end, end)
        # The last slot is answered too: with it the agents say where they are at its end.
        answer(slots, SECOND + slots * slot_ns, np.zeros(0, np.uint8))
