"""`dtsa fake-modem`: simulated serial modems."""

from __future__ import annotations

import argparse
import json

DESCRIPTION = """\
Simulated half-duplex modems on pseudo terminals: agents (--air serial --device DIR/modem1 ...) and other programs
open them as they open real ones. What they are given is on one air, where packets that overlap are lost. Ctrl-C ends
them and prints what became of the packets."""
_PATIENCE_S = 0.1
_CHANNEL = ("seed", "loss", "burst_length", "burst_scope", "partition")


def add_parser(subparsers: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    """Register the command."""
    from dtsa_agent.core.settings.declaration import settings_of
    from dtsa_bench.network.fake_modems import FakeModemSettings
    from dtsa_bench.runs.options import add_options
    from dtsa_channel_sim import ChannelConfig

    parser = subparsers.add_parser(
        "fake-modem", help="simulated serial modems on pseudo terminals", description=DESCRIPTION
    )
    parser.add_argument("--dir", metavar="DIR", required=True, help="where modem1, modem2, ... lead to the devices")
    add_options(parser, FakeModemSettings, "modem")
    others = (setting.name for setting in settings_of(ChannelConfig) if setting.name not in _CHANNEL)
    add_options(parser.add_argument_group("the air between them"), ChannelConfig, "channel", skip=others)


def run(args: argparse.Namespace) -> int:
    """Carry packets until a signal comes."""
    import time
    from pathlib import Path

    from dtsa_agent.core.errors import ConfigError
    from dtsa_agent.stop import Stop
    from dtsa_bench.network.fake_modems import FakeModems, FakeModemSettings
    from dtsa_bench.runs.options import given
    from dtsa_channel_sim import ChannelConfig

    settings = FakeModemSettings.from_dict(given(args, FakeModemSettings, "modem"))
    channel = FakeModems.channel(settings.count, **given(args, ChannelConfig, "channel"))
    directory = Path(args.dir)
    try:
        directory.mkdir(parents=True, exist_ok=True)
        with Stop() as stop, FakeModems(settings, channel, directory) as modems:
            for device in modems.devices:
                print(device, flush=True)
            while not stop:
                time.sleep(_PATIENCE_S)
    except OSError as error:
        raise ConfigError("dir", args.dir, f"a directory in which links can be made ({error.strerror})") from None
    print(json.dumps(modems.counts))
    return 0
