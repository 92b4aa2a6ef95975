"""Integration: the laboratory's dongles: the ground's programs talk to apps, and hear what they say to each other."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path

import pytest
from live_helpers import LiveLaboratory, live_laboratory

from dtsa_agent.crazyflie.link import SIMULATED_RADIO
from dtsa_bench.crazyflies.peer_lab import LabSettings, read_app
from dtsa_bench.crazyflies.peer_lab.compiling import compiler
from dtsa_bench.crazyflies.simulated.radio import dongle as requests
from dtsa_bench.crazyflies.simulated.radio.air import BROADCAST

pytestmark = pytest.mark.skipif(shutil.which(compiler()[0]) is None, reason="no C compiler")

APP = """
#include "app.h"
#include "configblock.h"
#include "log.h"
#include "radiolink.h"
#include "task.h"
static uint16_t heard;
static void hear(P2PPacket *p) { if (p->port == 3) heard += p->size; }
void appMain(void) {
    static P2PPacket packet;
    p2pRegisterCB(hear);
    packet.port = 5; packet.size = 4; packet.data[0] = configblockGetRadioAddress() & 255;
    for (;;) { radiolinkSendP2PPacketBroadcast(&packet); vTaskDelay(20); }
}
LOG_GROUP_START(own)
LOG_ADD(LOG_UINT16, heard, &heard)
LOG_GROUP_STOP(own)
"""


@pytest.fixture
def live(tmp_path: Path) -> Iterator[LiveLaboratory]:
    directory = tmp_path / "echo"
    directory.mkdir()
    (directory / "app.c").write_text(APP)
    settings = LabSettings(agents=2, boot_s=0.05)
    with LiveLaboratory(tmp_path / "radio", 4, read_app(directory), settings) as lab:
        yield lab


def sniff(live: LiveLaboratory) -> list[bytes]:
    dongle, heard = live.server.dongles[0], []

    def give(transfer: bytes) -> None:
        heard.append(transfer[7:])
        dongle.sniffer.read()

    dongle.request(requests.SET_CHANNEL, 80, b"", 0)
    dongle.request(requests.SET_RATE, 2, b"", 0)
    dongle.request(requests.SET_SNIFFER_ADDRESS, 0, BROADCAST, 0)
    dongle.request(requests.SET_RADIO_MODE, 1, b"", 0)
    dongle.sniffer.give = give
    dongle.sniffer.read()
    return heard


def test_a_dongle_in_sniffer_mode_hears_apps_and_they_hear_it(live: LiveLaboratory) -> None:
    heard = sniff(live)
    live.run(0.5)
    assert {packet[:3] for packet in heard} == {b"\xff\x85\x01", b"\xff\x85\x02"}
    assert all(len(packet) == 6 for packet in heard)
    live.server.dongles[0].transfer(BROADCAST + b"\xff\x83hello", live.now_ns, lambda data: None)
    live.run(0.6)
    assert {live.log(agent, "own.heard") for agent in (1, 2)} == {5.0}


CFLIB = """
import sys, time
from dtsa_agent.core import SwarmConfig
from dtsa_agent.crazyflie.link import require_cflib
require_cflib()
from cflib.crazyflie import Crazyflie
from cflib.crazyflie.log import LogConfig
from cflib.crazyflie.syncCrazyflie import SyncCrazyflie
from cflib.crazyflie.syncLogger import SyncLogger
with SyncCrazyflie("radio://0/80/2M/E7E7E7E702", cf=Crazyflie(rw_cache=sys.argv[1])) as link:
    link.cf.param.set_value("beacons.period", 77)
    link.cf.high_level_commander.takeoff(0.8, 1.0)
    config = LogConfig("both", 100)
    config.add_variable("beacons.heard")
    config.add_variable("stateEstimate.z", "float")
    with SyncLogger(link, config) as logger:
        for _, values, _ in logger:
            if values["stateEstimate.z"] > 0.7 and values["beacons.heard"] > 5:
                break
    print(link.cf.param.get_value("beacons.period"))
"""


def test_unmodified_cflib_finds_an_apps_variables_and_flies_its_vehicle(tmp_path: Path) -> None:
    pytest.importorskip("cflib")
    with live_laboratory(tmp_path, "beacons", "2"):
        time.sleep(1.5)  # both are switched on
        command = [sys.executable, "-c", CFLIB, str(tmp_path / "cache")]
        environment = {**os.environ, SIMULATED_RADIO: str(tmp_path / "radio")}
        said = subprocess.run(command, capture_output=True, text=True, check=False, env=environment, timeout=120)
    assert said.stdout.split() == ["77"], said.stderr
