"""What a slot costs the app on board: instructions and stack on a simulated Cortex-M4F, memory, and air.

The program is ``board_cost.c``: `onboard/app.c` as it is, among agents that run `onboard/board.c`.
"""

from __future__ import annotations

import os
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import dtsa_agent
from dtsa_bench.crazyflies.peer_lab.app import read_app
from dtsa_bench.crazyflies.peer_lab.compiling import FIRMWARE
from dtsa_bench.crazyflies.simulated.radio import esb
from dtsa_bench.experiments.batch.made_with import made_with
from dtsa_channel_sim.model.airtime import airtime_of

from .embedded import CORTEX, IN_PARTS, qemu, run_program
from .library import HERE, compile_program, sources, tool

ONBOARD = Path(dtsa_agent.__file__).parent / "onboard"
SLOT_MS = 10.0  # of the app's default
POLLS_HZ = 10.0
KINDS = ("hear", "decide", "send", "steer", "slot", "awake")  # in the order of board_cost.c
#: A model, not measured: cycles of an average instruction with the processor's caches and flash.
CYCLES = 1.5
CLOCK_MHZ = 168.0
STACK_BYTES = 4000  # of the app's task: 1000 words
_LIMIT_S = 600.0


@dataclass(frozen=True, slots=True)
class BoardCost:
    """What one policy costs with so many agents."""

    policy: str
    agents: int
    slots: int  # looked at, while it steers
    stack: int  # bytes, with the frame of appMain
    instructions: dict[str, tuple[int, int]]  # by kind of turn: mean, most
    datagram: int  # bytes
    frames_of_air: float  # share of the time
    polls_of_air: float

    def microseconds(self, kind: str) -> tuple[float, float]:
        """Mean and most at 168 MHz, by the model of cycles, us.

        :param kind: one of :data:`KINDS`.
        """
        mean, most = (count * CYCLES / CLOCK_MHZ for count in self.instructions[kind])
        return mean, most


def fly_app_on_cortex(directory: Path, slots: int = 200, sample: bool = False) -> list[BoardCost]:
    """The app's loop on a Cortex-M4F in QEMU, with 12 agents and with as many as it is made for.

    :param directory: for the program.
    :param slots: of each flight, from when the app steers.
    :param sample: the greatest swarm with ``lease`` alone.
    :raises NotHere: where compiler or QEMU are missing.
    """
    compiler = tool("arm-none-eabi-gcc", "gcc-arm-none-eabi libnewlib-arm-none-eabi")
    board = ["-Os", "-nostartfiles", "--specs=rdimon.specs", f"-T{HERE / 'mps2.ld'}", f"-DSLOTS={slots}"]
    board += ["-DSAMPLE"] if sample else []
    files = [HERE / "board_cost.c", HERE / "mps2.c", *(path for path in _sources() if path.name != "app.c")]
    flags = [*CORTEX, *IN_PARTS, *board, *_folders()]
    program = compile_program(compiler, directory / "board.elf", files, flags)
    text = run_program([*qemu(), "-icount", "shift=5", "-kernel", str(program)], _LIMIT_S)
    return [_read(line, _frame_of_app(directory)) for line in text.splitlines()]


def memory(directory: Path) -> dict[str, int]:
    """Bytes of code with constants, and of RAM without the task's stack, of all that is on board.

    :param directory: for object files.
    """
    compiler = tool("arm-none-eabi-gcc", "gcc-arm-none-eabi libnewlib-arm-none-eabi")
    size = tool("arm-none-eabi-size", "binutils-arm-none-eabi")
    sums = {"code": 0, "ram": 0}
    for path in _sources():
        out = directory / f"{path.parent.name}-{path.stem}.o"
        compile_program(compiler, out, [path], [*CORTEX, "-Os", "-c", *_folders()], links=())
        text, data, bss = map(int, run_program([size, str(out)]).splitlines()[1].split()[:3])
        sums["code"] += text + data
        sums["ram"] += data + bss
    return sums


def record(costs: Sequence[BoardCost], sizes: dict[str, int]) -> dict[str, Any]:
    """``docs/evidence/board-cost.json``.

    :param costs: of :func:`fly_app_on_cortex`. :param sizes: of :func:`memory`.
    """
    return {
        "command": "embedded --board",
        "promise": "what a slot costs the app on board, in QEMU: its deepest stack is below that of its task, and its "
        "longest slot below half of the slot",
        **made_with(), "load_of_items": [round(os.getloadavg()[0], 2)] * 2,
        "cycles_an_instruction": CYCLES, "clock_mhz": CLOCK_MHZ, "slot_ms": SLOT_MS, "polls_hz": POLLS_HZ,
        "stack_of_task": STACK_BYTES, "memory": sizes, "costs": [asdict(cost) for cost in costs],
    }  # fmt: skip


def _sources() -> list[Path]:
    return list(dict.fromkeys(path.resolve() for path in (*read_app(str(ONBOARD)).sources, *sources())))


def _folders() -> list[str]:
    return [f"-I{path}" for path in (HERE, ONBOARD, FIRMWARE, *read_app(str(ONBOARD)).include)]


def _frame_of_app(directory: Path) -> int:
    """Bytes of stack of appMain itself, which the program looks at from below."""
    compiler = tool("arm-none-eabi-gcc", "gcc-arm-none-eabi libnewlib-arm-none-eabi")
    out = directory / "frame.o"
    compile_program(compiler, out, [ONBOARD / "app.c"], [*CORTEX, "-Os", "-c", "-fstack-usage", *_folders()], links=())
    lines = out.with_suffix(".su").read_text().splitlines()
    return next(int(line.split("\t")[1]) for line in lines if line.split("\t")[0].endswith(":appMain"))


def _read(line: str, frame: int) -> BoardCost:
    policy, agents, slots, stack, *numbers = line.split()
    values = [int(number) for number in numbers]
    costs = {kind: (values[2 * i], values[2 * i + 1]) for i, kind in enumerate(KINDS)}
    datagram, count = values[-1], int(agents)
    air = airtime_of("crazyflie", esb.BITRATES["2M"], esb.TURN_NS, 0)
    # An empty packet up; down an empty one with its signal strength, or in every second one a state of 26 bytes.
    up, down = esb.on_air_ns(1, "2M"), (esb.on_air_ns(3, "2M") + esb.on_air_ns(30, "2M")) / 2
    return BoardCost(
        policy, count, int(slots), int(stack) + frame, costs, datagram,
        air.on_air_ns(datagram) / (SLOT_MS * 1e6), POLLS_HZ * count * (up + down) / 1e9,
    )  # fmt: skip
