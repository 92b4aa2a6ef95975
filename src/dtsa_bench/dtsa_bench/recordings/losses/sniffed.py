"""What a listener on a network missed: frames that were due, by the policy's turns, and that it did not hear."""

from __future__ import annotations

import json
import struct
from pathlib import Path

import numpy as np
from mcap.exceptions import McapError
from mcap.records import Channel, Message, Metadata
from mcap.stream_reader import StreamReader
from zstandard import ZstdError

from dtsa_agent.core import SwarmConfig
from dtsa_agent.core.errors import ConfigError
from dtsa_agent.core.reference.lease.memory import Memory
from dtsa_agent.core.reference.rules import Rules
from dtsa_bench.recordings.bag.errors import UnusableBag
from dtsa_channel_sim.model.loss_record import HEARD, LOST, MOST, UNKNOWN
from dtsa_channel_sim.model.loss_table import LossTable

#: Topic of the frames of such a bag, and name of its metadata record.
FRAME, METADATA = "frame", "dtsa_sniffer"
FILE = "sniffed.mcap"
_LONGEST_RECORD = 1 << 24  # bytes
_DAMAGE = (McapError, ZstdError, struct.error, EOFError, ValueError, KeyError, TypeError)


def read_sniffed(path: Path) -> tuple[LossTable, SwarmConfig] | None:
    """What a listener heard and missed; None: the file is none of a listener.

    The listener is receiver 0. It cannot know of frames that it missed, but for those that were due: with `tdma` in
    all turns, with `lease` in main anchors, which nobody gives away.

    :param path: the .mcap file.
    :raises UnusableBag: if it is damaged.
    :raises ConfigError: if its policy does not say which frames are due.
    """
    config: SwarmConfig | None = None
    heard: dict[int, list[int]] = {}  # slots by sender
    topics: dict[int, str] = {}
    try:
        with path.open("rb") as stream:
            for record in StreamReader(stream, validate_crcs=True, record_size_limit=_LONGEST_RECORD).records:
                if isinstance(record, Metadata) and record.name == METADATA:
                    config = SwarmConfig.from_dict(json.loads(record.metadata["swarm"]))
                elif isinstance(record, Channel):
                    topics[record.id] = record.topic
                elif isinstance(record, Message):
                    if config is None:
                        return None
                    if topics.get(record.channel_id) != FRAME:
                        continue
                    said = json.loads(record.data)
                    if not said["reason"]:
                        heard.setdefault(int(said["sender"]), []).append(int(said["slot"]))
    except ConfigError:
        raise
    except OSError as error:
        raise UnusableBag(path, error.strerror or str(error)) from None
    except _DAMAGE as error:
        if config is None:
            return None
        if not heard:
            raise UnusableBag(path, f"not readable ({error})") from None
    if config is None:
        return None
    if not heard:
        raise UnusableBag(path, "nobody was heard in it")
    return _table(path, config, heard), config


def _table(path: Path, config: SwarmConfig, heard: dict[int, list[int]]) -> LossTable:
    """The frames that were due between the first and the last one that was heard of their sender."""
    if config.policy not in ("tdma", "lease"):
        allowed = "a flight of tdma or lease: of other policies nobody knows which frames were due"
        raise ConfigError("policy", f"{config.policy} in {path}", allowed)
    agents = config.agents
    main = Memory(Rules(agents=agents, slot_s=1.0, anchor_every=config.anchor_every, main_every=config.main_every))
    slots, senders, outcomes = [], [], []
    for sender, known in sorted(heard.items()):
        first, last = min(known), max(known)
        if (last - first) // agents * (agents + 1) > MOST:
            raise UnusableBag(path, f"agent {sender} was heard in slots {first} and {last}: too far apart")
        due = np.arange(first + (sender - 1 - first) % agents, last + 1, agents)
        if config.policy == "lease":
            due = due[[main.is_main(slot) for slot in due.tolist()]] if len(due) else due
        slots.append(due)
        senders.append(np.full(len(due), sender))
        outcomes.append(np.where(np.isin(due, known), HEARD, LOST))
    order = np.argsort(np.concatenate(slots), kind="stable")
    outcome = np.full((len(order), agents + 1), UNKNOWN, np.uint8)
    outcome[:, 0] = np.concatenate(outcomes)[order]
    if not len(order):
        raise UnusableBag(path, "no frame was due between the first and the last that were heard")
    return LossTable(np.concatenate(slots)[order], np.concatenate(senders)[order], outcome)
