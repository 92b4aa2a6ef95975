"""Writes a merged flight into a directory, whole or not at all."""

from __future__ import annotations

import json
import shutil
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from dtsa_agent.core.errors import ConfigError
from dtsa_agent.ros.common.graph import names
from dtsa_bench.recordings.bag.errors import BagError
from dtsa_bench.recordings.bag.metadata import MERGED_FROM, RUN_ID
from dtsa_bench.recordings.bag.writer import BagWriter

from .merged_messages import LATCHED, TOPICS, MergedMessages
from .merged_run import MergedRun


def check_free(directory: Path) -> None:
    """Whether a flight can be written there.

    :raises ConfigError: if something is there already.
    """
    if directory.exists() and (not directory.is_dir() or any(directory.iterdir())):
        raise ConfigError("out", str(directory), "a directory that is empty or does not exist yet")


def write(directory: Path, run: MergedRun, summary: Mapping[str, Any]) -> Path:
    """Writes `bag` and `summary.json`, as flights leave them.

    :param directory: where to; must not exist, or be empty.
    :raises ConfigError: if something is there already.
    :raises BagError: if it cannot be written.
    """
    check_free(directory)
    messages = MergedMessages(run)
    whole = directory.resolve()
    part = whole.with_name(f".{whole.name}.part")
    try:
        shutil.rmtree(part, ignore_errors=True)  # of an earlier run that was killed
        part.mkdir(parents=True)
        _write_bag(part / "bag", run, messages)
        (part / "summary.json").write_text(json.dumps(summary, indent=2) + "\n", encoding="utf-8")
        part.replace(whole)  # also where that is an empty directory
    except OSError as error:
        raise BagError(f"cannot write to {directory}: {error.strerror or error}") from error
    finally:
        shutil.rmtree(part, ignore_errors=True)
    return directory / "bag"


def _write_bag(directory: Path, run: MergedRun, messages: MergedMessages) -> None:
    custom = {MERGED_FROM: json.dumps(run.about, sort_keys=True), RUN_ID: f"{messages.run_id:08x}"}
    with BagWriter(directory, messages.config, custom_data=custom) as bag:
        channels = {
            topic: bag.add_topic(topic, kind, "latched" if topic in LATCHED else "reliable")
            for topic, kind in TOPICS.items()
        }
        for agent in range(1, run.config.agents + 1):
            topic = f"{names.agent_namespace(agent)}/{names.ODOMETRY}"
            channels[topic] = bag.add_topic(topic, "nav_msgs/msg/Odometry")
        for out in messages:
            bag.write(channels[out.topic], out.data, out.time_ns, out.time_ns)
