"""Apps in the peer-to-peer laboratory: what they may do, what the radio does, and that a seed gives its bits again."""

from __future__ import annotations

import shutil
import subprocess
import tempfile
from pathlib import Path
from typing import Any

import pytest

from dtsa_agent.core.errors import ConfigError
from dtsa_bench.crazyflies.peer_lab import Laboratory, LabSettings, read_app
from dtsa_bench.crazyflies.peer_lab.compiling import ENGINE, FIRMWARE, CompileError, compiler
from dtsa_bench.crazyflies.peer_lab.engine import AppError
from dtsa_bench.crazyflies.peer_lab.process import fly
from dtsa_channel_sim.model.airtime import RADIOS

pytestmark = pytest.mark.skipif(shutil.which(compiler()[0]) is None, reason="no C compiler")

ALONE = LabSettings(agents=1, boot_s=0.0)
HEADERS = (
    "app app_channel cfassert commander configblock crtp_commander_high_level debug log param peer_lab pm radiolink "
    "semphr static_mem supervisor timers usec_time"
)
HEAD = "".join(f'#include "{name}.h"\n' for name in HEADERS.split()) + "#include <string.h>\n"


@pytest.fixture
def write(tmp_path: Path):

    def make(code: str, settings: str = "{}") -> str:
        directory = Path(tempfile.mkdtemp(dir=tmp_path))
        (directory / "app.c").write_text(HEAD + code)
        (directory / "app.yaml").write_text(settings)
        return str(directory)

    return make


# Code of an app by what it shows, how long it flies (s), and what it prints.
APPS = {
    "time goes on by ticks and by calls": ("""
void appMain(void) {
    TickType_t ticks = xTaskGetTickCount();
    vTaskDelay(M2T(5));
    DEBUG_PRINT("%d\\n", (int)(xTaskGetTickCount() - ticks));
    uint64_t end = usecTimestamp() + 300;
    int calls = 0;
    while (usecTimestamp() < end) calls++;
    DEBUG_PRINT("%d\\n", calls > 250 && calls <= 300);
    uint64_t before = usecTimestamp();
    peerLabSpend(2500);
    DEBUG_PRINT("%d\\n", usecTimestamp() - before >= 2500);
    TickType_t due = xTaskGetTickCount();
    for (int i = 0; i < 3; i++) vTaskDelayUntil(&due, 7);
    DEBUG_PRINT("%lu\\n", (unsigned long)(xTaskGetTickCount() - due));
}""", 1.0, ["5", "1", "1", "0"]),
    "queues wait for items and for room": ("""
STATIC_MEM_QUEUE_ALLOC(numbers, 2, sizeof(int));
static QueueHandle_t numbers;
static void other(void *argument) {
    (void)argument;
    for (int i = 0; i < 4; i++) { xQueueSend(numbers, &i, portMAX_DELAY); vTaskDelay(3); }
    vTaskDelete(NULL);
}
void appMain(void) {
    numbers = STATIC_MEM_QUEUE_CREATE(numbers);
    int got = -1;
    DEBUG_PRINT("%d\\n", (int)xQueueReceive(numbers, &got, 4));
    xTaskCreate(other, "other", 200, NULL, 1, NULL);
    for (int i = 0; i < 4; i++) { xQueueReceive(numbers, &got, M2T(100)); DEBUG_PRINT("%d\\n", got); }
    for (int i = 0; i < 3; i++) DEBUG_PRINT("%d\\n", (int)xQueueSend(numbers, &i, 2));
    SemaphoreHandle_t mutex = xSemaphoreCreateMutex();
    for (int i = 0; i < 2; i++) DEBUG_PRINT("%d\\n", (int)xSemaphoreTake(mutex, 3));
    xSemaphoreGive(mutex);
    DEBUG_PRINT("%d\\n", (int)xSemaphoreTake(mutex, 0));
}""", 1.0, ["0", "0", "1", "2", "3", "1", "1", "0", "1", "0", "1"]),
    "a timer runs until it is stopped": ("""
static int runs;
static void tick(TimerHandle_t timer) { if (++runs == 3) xTimerStop(timer, 0); }
void appMain(void) {
    TimerHandle_t timer = xTimerCreate("t", 5, pdTRUE, NULL, tick);
    xTimerStart(timer, 0);
    vTaskDelay(12); DEBUG_PRINT("%d\\n", runs);
    vTaskDelay(50); DEBUG_PRINT("%d\\n", runs);
}""", 1.0, ["2", "3"]),
    "parameters of the firmware": ("""
void appMain(void) {
    paramVarId_t deck = paramGetVarId("deck", "bcLighthouse4"), effect = paramGetVarId("ring", "effect");
    paramSetInt(effect, 9);
    vTaskDelay(M2T(20));
    paramVarId_t none = paramGetVarId("no", "one");
    DEBUG_PRINT("%u %d %d\\n", paramGetUint(deck), paramGetInt(effect), PARAM_VARID_IS_VALID(none));
    paramSetInt(paramGetVarId("stabilizer", "stop"), 1);
    vTaskDelay(M2T(20));
    DEBUG_PRINT("%d\\n", supervisorIsLocked());
}""", 1.0, ["1 9 0", "1"]),
    "flies its vehicle": ("""
static logVarId_t z, x;
void appMain(void) {
    z = logGetVarId("stateEstimate", "z"); x = logGetVarId("stateEstimate", "x");
    while (!supervisorCanFly()) vTaskDelay(10);
    DEBUG_PRINT("takeoff %d\\n", crtpCommanderHighLevelTakeoff(1.0f, 2.0f));
    vTaskDelay(M2T(2500));
    float start = logGetFloat(x);
    DEBUG_PRINT("%d %d\\n", logGetFloat(z) > 0.9f, supervisorIsFlying());
    DEBUG_PRINT("%d\\n", crtpCommanderHighLevelIsTrajectoryFinished());
    static setpoint_t s;
    s.mode.x = s.mode.y = s.mode.z = modeVelocity; s.velocity.x = 0.5f;
    for (int i = 0; i < 200; i++) { commanderSetSetpoint(&s, COMMANDER_PRIORITY_EXTRX); vTaskDelay(M2T(10)); }
    float way = logGetFloat(x) - start;
    DEBUG_PRINT("%d %d\\n", way > 0.7f && way < 1.1f, commanderGetActivePriority());
    commanderRelaxPriority();
    DEBUG_PRINT("land %d\\n", crtpCommanderHighLevelLand(0.0f, 2.0f));
    vTaskDelay(M2T(6000));
    DEBUG_PRINT("%d %d\\n", supervisorIsFlying(), logGetFloat(z) < 0.1f);
}""", 12.0, ["takeoff 0", "1 1", "1", "1 3", "land 0", "0 1"]),
    "falls when its setpoints cease": ("""
void appMain(void) {
    while (!supervisorCanFly()) vTaskDelay(10);
    crtpCommanderHighLevelTakeoff(1.0f, 2.0f);
    vTaskDelay(M2T(2500));
    static setpoint_t s;
    s.mode.x = s.mode.y = s.mode.z = modeVelocity;
    commanderSetSetpoint(&s, COMMANDER_PRIORITY_EXTRX);
    vTaskDelay(M2T(3000));
    DEBUG_PRINT("%d\\n", supervisorIsLocked());
}""", 7.0, ["1"]),
}  # fmt: skip


@pytest.mark.parametrize("what", APPS)
def test_what_an_app_may_do(what: str, write) -> None:
    code, seconds, printed = APPS[what]
    with Laboratory(read_app(write(code)), ALONE) as lab:
        lab.run(seconds)
        assert [line for _, _, line in lab.record.console] == printed


@pytest.mark.parametrize("app", ["beacons", "dtr"])
def test_engine_and_own_apps_compile_without_warnings(app: str, tmp_path: Path) -> None:
    flags = ["-std=gnu11", "-O2", "-Wall", "-Wextra", "-Werror", f"-I{FIRMWARE}", f"-I{ENGINE}", "-fsyntax-only"]
    sources = [*ENGINE.glob("*.c"), *read_app(app).sources]
    subprocess.run([*compiler(), *flags, *map(str, sources)], check=True)


def test_every_header_stands_alone(tmp_path: Path) -> None:
    for header in FIRMWARE.glob("*.h"):
        (tmp_path / f"{header.stem}.c").write_text(f'#include "{header.name}"\n')
    command = [*compiler(), "-std=gnu11", "-Wall", "-Wextra", "-Werror", f"-I{FIRMWARE}", "-fsyntax-only"]
    subprocess.run([*command, *map(str, tmp_path.glob("*.c"))], check=True)


def test_a_clock_drifts(write) -> None:
    place = write("""
void appMain(void) { vTaskDelay(M2T(20000)); DEBUG_PRINT("%u\\n", (unsigned)usecTimestamp()); }""")
    with Laboratory(read_app(place), LabSettings(agents=2, boot_s=0.0, drift_ppm=1000.0)) as lab:
        lab.run(21.0)
        times = [time for time, _, _ in lab.record.console]
    assert len(times) == 2
    assert all(abs(time - 20.0) < 0.021 for time in times)
    assert abs(times[0] - times[1]) > 1e-4


def test_parameters_and_log_variables_have_names(write) -> None:
    place = write("""
static uint8_t mode; static float gain = 0.5f; static int32_t seen; static int report;
static void changed(void) { report++; }
static float twice(uint32_t time, void *data) { (void)time; (void)data; return 2.0f * gain; }
static logByFunction_t doubled = {.aquireFloat = twice};
void appMain(void) {
    for (;;) { seen = paramGetInt(paramGetVarId("own", "mode")) * 10 + report; vTaskDelay(1); }
}
PARAM_GROUP_START(own)
PARAM_ADD_WITH_CALLBACK(PARAM_UINT8, mode, &mode, changed)
PARAM_ADD(PARAM_FLOAT | PARAM_PERSISTENT, gain, &gain)
PARAM_GROUP_STOP(own)
LOG_GROUP_START(own)
LOG_ADD(LOG_INT32, seen, &seen)
LOG_ADD_BY_FUNCTION(LOG_FLOAT, doubled, &doubled)
LOG_GROUP_STOP(own)
""")
    with Laboratory(read_app(place), ALONE) as lab:
        lab.run(0.01)
        assert lab.logs(1) == {"own.seen": 0.0, "own.doubled": 1.0}
        lab.set_parameter(1, "own.mode", 3)
        lab.set_parameter(1, "own.gain", 1.25)
        lab.run(0.02)
        assert lab.logs(1) == {"own.seen": 31.0, "own.doubled": 2.5}
        assert lab.parameter(1, "own.mode") == 3
        with pytest.raises(ConfigError, match=r"own\.mode"):
            lab.set_parameter(1, "own.other", 1)


def test_app_channel_carries_both_ways_and_says_when_it_overflowed(write) -> None:
    place = write("""
void appMain(void) {
    char text[30];
    vTaskDelay(20);
    DEBUG_PRINT("%d\\n", appchannelHasOverflowOccurred());
    for (;;) {
        size_t length = appchannelReceiveDataPacket(text, sizeof text, 50);
        DEBUG_PRINT("%d\\n", (int)length);
        if (!length) break;
    }
    appchannelSendDataPacket("over", 4);
}""")
    with Laboratory(read_app(place), ALONE) as lab:
        lab.run(0.005)
        taken = [lab.send(1, bytes(k + 1)) for k in range(12)]
        lab.run(0.2)
        assert taken == [True] * 10 + [False] * 2
        assert [line for _, _, line in lab.record.console] == ["1", *map(str, range(1, 11)), "0"]
        assert [(agent, data) for _, agent, data in lab.from_apps] == [(1, b"over")]


SENDER = """
static void hear(P2PPacket *p) {
    peerLabRecord(p->data, p->size);
    DEBUG_PRINT("%u %d %d\\n", (unsigned)usecTimestamp(), p->size, p->data[0]);
}
void appMain(void) {
    static P2PPacket packet;
    uint8_t id = configblockGetRadioAddress() & 255;
    p2pRegisterCB(hear);
    packet.port = 3; packet.size = 20; packet.data[0] = id;
    vTaskDelay(10);
    BODY
}"""


def test_frames_take_their_time_and_meet_on_the_air(write) -> None:
    place = write(SENDER.replace("BODY", "if (id == 1) radiolinkSendP2PPacketBroadcast(&packet);"))
    with Laboratory(read_app(place), LabSettings(agents=2, boot_s=0.0)) as lab:
        lab.run(0.1)
        ((heard_us, size, sender),) = [map(int, line.split()) for _, _, line in lab.record.console]
    line = RADIOS["crazyflie"].airtime
    on_air_us = 130 + (73 + 8 * 22) / 2
    way_us = (line.to_radio_ns(20) + line.from_radio_ns(20)) / 1000 + on_air_us
    assert (size, sender) == (20, 1)
    assert 10_000 + way_us <= heard_us <= 10_000 + way_us + 10  # and a few calls
    place = write(SENDER.replace("BODY", "if (id < 3) radiolinkSendP2PPacketBroadcast(&packet);"))
    with Laboratory(read_app(place), LabSettings(agents=3, boot_s=0.0)) as lab:
        lab.run(0.1)
        assert sum(lab.record.sent) == 2
        assert lab.record.heard == [0, 0, 0]
    # Vehicle 2 turns to sending while the frame of 1 ends: 3 has it, as nothing of 2 is on the air yet.
    wait = "if (id == 1) radiolinkSendP2PPacketBroadcast(&packet); if (id == 2) { peerLabSpend(150);"
    place = write(SENDER.replace("BODY", wait + " radiolinkSendP2PPacketBroadcast(&packet); }"))
    with Laboratory(read_app(place), LabSettings(agents=3, boot_s=0.0)) as lab:
        lab.run(0.1)
        heard = sorted((agent, line.split()[2]) for _, agent, line in lab.record.console)
    assert heard == [(1, "2"), (3, "1"), (3, "2")]


def test_receptions_that_find_the_queue_full_are_lost(write) -> None:
    # Handing 60 bytes over takes longer than hearing them: two that send by turns fill the queue of a third.
    code = """
    packet.size = 60;
    if (id == 2) peerLabSpend(330);
    if (id < 3) for (int i = 0; i < 60; i++) radiolinkSendP2PPacketBroadcast(&packet);"""
    place = write(SENDER.replace("BODY", code))
    with Laboratory(read_app(place), LabSettings(agents=3, boot_s=0.0)) as lab:
        lab.run(0.5)
        assert lab.overflows[2] > 0
        assert lab.summary()["queue_overflows"] >= lab.overflows[2]
        assert lab.record.heard[2] > 60


def test_the_ground_gives_orders_at_instants(write) -> None:
    place = write(
        "static uint8_t go; void appMain(void) { for (;;) vTaskDelay(100); }\n"
        "PARAM_GROUP_START(own)\nPARAM_ADD(PARAM_UINT8, go, &go)\nPARAM_GROUP_STOP(own)",
        settings="parameters: {own.go: 1}",
    )
    with Laboratory(read_app(place), LabSettings(agents=2, boot_s=0.0)) as lab:
        lab.at(0.5, lambda: [lab.take_off(agent, 1.0, 1.0) for agent in (1, 2)] and None)
        lab.at(2.0, lambda: lab.set_parameter(2, "own.go", 7))
        lab.at(2.0, lambda: lab.switch_off(1))
        lab.run(1.9)
        assert [lab.parameter(agent, "own.go") for agent in (1, 2)] == [1, 1]
        assert (lab.motion.vehicles.position[2] > 0.8).all()
        lab.run(3.0)
        assert lab.parameter(2, "own.go") == 7
        assert lab.summary()["crashed"] == [1]  # it fell: its power was off


@pytest.mark.parametrize(
    ("code", "said"),
    [
        ("void appMain(void) { for (;;) usecTimestamp(); }", "never yields"),
        ("void appMain(void) { volatile int *p = 0; vTaskDelay(5); *p = 1; }", "agent 1, task app, at 0.005"),
        ("void appMain(void) { ASSERT(1 == 2); }", r"assertion failed in app\.c:"),
        ("void appMain(void) { xQueueSend(NULL, NULL, 0); }", "a queue that was not created"),
        ("int deep(int n) { volatile char room[900]; room[0] = n; return n ? deep(n + 1) + room[0] : 0; }\n"
         "void appMain(void) { deep(1); }", "stack overflowed"),
        ("void appMain(void) { volatile int on = 1; while (on) { } }", "computes for ever"),
    ],
)  # fmt: skip
def test_an_app_that_fails_is_named(write, code: str, said: str) -> None:
    with pytest.raises(AppError, match=said) as error:
        fly(read_app(write(code)), 2.0, ALONE)
    assert "agent 1" in str(error.value)


@pytest.mark.parametrize(("code", "settings", "error", "said"), [
    ("void appMain(void) { nonsense(); } syntax", "{}", CompileError, "error"),
    ("void eventQueueSend(void); void appMain(void) { eventQueueSend(); }", "{}", CompileError, "eventQueueSend"),
    ("int other;", "{}", AppError, "appMain"), ("", "parameters: {own.go: fast}", ConfigError, "parameters"),
    ("", "sorces: [x.c]", ConfigError, "sorces"),
])  # fmt: skip
def test_bad_input_is_said_in_a_line(write, code: str, settings: str, error: type[Exception], said: str) -> None:
    with pytest.raises(error, match=said):
        fly(read_app(write(code, settings)), 1.5)
    with pytest.raises(ConfigError, match="beacons, dtr"):
        read_app("nowhere")


def test_a_ground_station_that_polls_takes_air_and_frames_survive_between_its_packets() -> None:
    def heard(polls: float) -> float:
        with Laboratory(read_app("beacons"), LabSettings(agents=4, polls=polls)) as lab:
            lab.run(4.0)
            if lab.polling is not None:
                assert lab.polling.answered > 0.9 * 4.0 * 4 * polls
            return sum(lab.record.heard) / sum(lab.record.sent) / 3

    assert heard(0.0) >= heard(50.0) > 0.5


def test_a_foreign_radio_is_heard_and_disturbs_and_losses_change_in_flight(write) -> None:
    place = write(SENDER.replace("BODY", "for (;;) { radiolinkSendP2PPacketBroadcast(&packet); vTaskDelay(50); }"))

    senders: list[int] = []
    recorded: list[bytes] = []

    def observe(kind: str, agent: int, now_ns: int, content: Any) -> None:
        if kind == "heard":
            senders.append(content.sender)
        elif kind == "record":
            recorded.append(content)

    with Laboratory(read_app(place), LabSettings(agents=2, boot_s=0.05), observers=[observe]) as lab:
        for k in range(5):
            lab.at(0.3 + 0.1 * k, lambda: lab.transmit(b"hello", port=3))
        lab.run(1.0)
        assert senders.count(0) == recorded.count(b"hello") > 5
        assert len(recorded) == len(senders)
        before = len(senders)
        lab.set_loss(1.0)
        lab.run(2.0)
        assert len(senders) == before


def test_sanitizers_find_what_an_app_does(write) -> None:
    place = write("""
static volatile char room[8]; volatile int place = 9; int top = 2147483647;
void appMain(void) { vTaskDelay(7); top += place; room[place] = (char)top; }""")
    for name in ("libubsan.so", "libasan.so"):
        asked = subprocess.run([*compiler(), f"-print-file-name={name}"], capture_output=True, text=True, check=True)
        if asked.stdout.strip() == name:
            pytest.skip(f"no {name}")
    assert "signed integer overflow" in fly(read_app(place, flags=("-fsanitize=undefined",)), 0.1, ALONE)["warnings"]
    with pytest.raises(AppError, match="global-buffer-overflow"):
        fly(read_app(place, flags=("-fsanitize=address",)), 0.1, ALONE)
