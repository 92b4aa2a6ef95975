"""`dtsa embedded`: libdtsa on a simulated microcontroller, the same bits as here, and what calls cost.

Programs: ``proofs/flight.c`` flies swarms on libdtsa alone; ``proofs/board_cost.c`` is the app on board
(``onboard/app.c``) as it is, among others that run the same station.
"""

from __future__ import annotations

import argparse
import re
import subprocess
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from dtsa_agent.core.errors import DtsaError
from dtsa_bench.commands.registry import Command
from dtsa_dev.proofs.programs import HERE, LIBRARY, compile_program, sources, tool

CALLS = ("slot", "command", "hear", "end")  # in the order of meter.h
TURNS = ("hear", "decide", "send", "steer", "slot", "awake")  # of the app, in the order of board_cost.c
#: Flags for the processor of a Crazyflie.
CORTEX = ("-mcpu=cortex-m4", "-mthumb", "-mfpu=fpv4-sp-d16", "-mfloat-abi=hard")
#: Flags of a firmware that fuses multiplications and additions where it may.
FUSING = ("-std=gnu11", "-O3", "-ffp-contract=fast", "-fno-math-errno")
IN_PARTS = ("-ffunction-sections", "-fdata-sections", "-Wl,--gc-sections")
#: A model, not measured: cycles of an average instruction with the processor's caches and flash.
CYCLES, CLOCK_MHZ = 1.5, 168.0
SLOT_MS, POLLS_HZ = 10.0, 10.0  # of the app's default; of the ground, to each vehicle
STACK_BYTES = 4000  # of the app's task: 1000 words
_ONBOARD = LIBRARY.parent / "onboard"


@dataclass(frozen=True, slots=True)
class EmbeddedFlight:
    """One of the flights of ``flight.c``; costs by call: instructions (mean, most), bytes of stack."""

    policy: str
    agents: int
    digest: str  # of all frames, decisions, tables and commands
    memory: int  # bytes of an agent
    costs: dict[str, tuple[int, int, int]]  # empty where they are not measured


@dataclass(frozen=True, slots=True)
class BoardCosts:
    """Costs of one policy in the app; instructions by kind of turn: mean, most."""

    policy: str
    agents: int
    slots: int  # counted, while it steers
    stack: int  # bytes, with the frame of appMain
    instructions: dict[str, tuple[int, int]]
    datagram: int  # bytes


class EmbeddedCommand(Command):
    description = """\
Compiles libdtsa for a Cortex-M4F, flies 200 slots of tdma, dtsa and lease with 12 and 18 agents and loss on it (in
QEMU) and on this machine, compares every bit, and prints what memory, stack, code and calls cost. With --board the app
of docs/how-to/on-board.md runs there instead, with 12 and 20 agents: what a slot costs it."""
    examples = (
        ("", "needs a cross compiler and QEMU, see docs/evidence/speed.md"),
        ("--board", "what a slot costs the app of Crazyflies"),
    )

    def add_arguments(self, parser: argparse.ArgumentParser) -> None:
        parser.add_argument("--board", action="store_true", help="the app of Crazyflies, instead of libdtsa alone")
        parser.add_argument("--out", metavar="FILE", help="write the table as JSON, as docs/evidence/embedded.json")

    def run(self, args: argparse.Namespace) -> int:
        """Fly and compare."""
        import tempfile

        from dtsa_dev.documents import table
        from dtsa_dev.records import write_record

        with tempfile.TemporaryDirectory() as place:
            heads, rows, sizes = _measure_board(Path(place)) if args.board else _measure_library(Path(place))
        print(f"{table(heads, rows)}\n{sizes}")
        if args.out:
            write_record(Path(args.out), f"embedded{' --board' * args.board} --out FILE", heads, rows, {"sizes": sizes})
        return int(any("NOT" in cell for row in rows for cell in row))


def _measure_library(directory: Path) -> tuple[list[str], list[list[str]], str]:
    """The table of `dtsa embedded`: heads, rows, sizes."""
    here, cortex = fly_here(directory), fly_on_cortex(directory)
    rows = []
    for flight, other in zip(cortex, here, strict=True):
        calls = [f"{mean:,} / {most:,}" for mean, most, _ in flight.costs.values()]
        stack = max(stack for *_, stack in flight.costs.values())
        same = "as here" if flight.digest == other.digest else f"NOT {other.digest}"
        memory = f"{flight.memory:,} B"
        rows.append([flight.policy, str(flight.agents), memory, f"{stack:,} B", *calls, f"{flight.digest}, {same}"])
    heads = ["policy", "N", "RAM of an agent", "stack", "slot, mean / most", *CALLS[1:], "digest"]
    sums: dict[str, int] = {}
    for path, (code, _) in _sizes(directory, sources(), "-O2").items():
        part = {"avoider": "avoiders", "lease": "policy lease"}.get(path.parent.name, "rest")
        sums[part] = sums.get(part, 0) + code
    return heads, rows, "Code and constants: " + ", ".join(f"{part} {size:,} B" for part, size in sorted(sums.items()))


def _measure_board(directory: Path) -> tuple[list[str], list[list[str]], str]:
    """The table of `dtsa embedded --board`: heads, rows, sizes."""
    from dtsa_bench.crazyflies.simulated.radio.air import BITRATES, TURN_NS, on_air_ns
    from dtsa_channel_sim.model.airtime import airtime_of

    air = airtime_of("crazyflie", BITRATES["2M"], TURN_NS, 0)
    # An empty packet up; down an empty one with its signal strength, or in every second one a state of 26 bytes.
    poll_ns = on_air_ns(1, "2M") + (on_air_ns(3, "2M") + on_air_ns(30, "2M")) / 2
    rows = []
    for cost in fly_app_on_cortex(directory):
        mean, most = (count * CYCLES / CLOCK_MHZ for count in cost.instructions["slot"])
        rows.append([
            cost.policy, str(cost.agents),
            *("{:,} / {:,}".format(*cost.instructions[kind]) for kind in TURNS[:-1]),
            f"{mean:,.0f} / {most:,.0f} us", f"{most / SLOT_MS / 10:.0f} %", f"{cost.stack:,} B", f"{cost.datagram} B",
            f"{100 * air.on_air_ns(cost.datagram) / (SLOT_MS * 1e6):.1f} %",
            f"{100 * POLLS_HZ * cost.agents * poll_ns / 1e9:.1f} %",
        ])  # fmt: skip
    heads = [
        "policy", "N", "hear, mean / most", *TURNS[1:4], "a slot", f"at {CLOCK_MHZ:g} MHz", "most, of a slot", "stack",
        "datagram", "frames, of the air", "polls",
    ]  # fmt: skip
    sizes = _sizes(directory, _app_sources(), "-Os").values()
    code, ram = sum(code for code, _ in sizes), sum(ram for _, ram in sizes)
    return heads, rows, f"Code and constants {code:,} B, RAM {ram:,} B, beside the stack of {STACK_BYTES:,} B"


def fly_here(directory: Path, slots: int = 200, soft: bool = False) -> list[EmbeddedFlight]:
    """The flights of ``flight.c`` on this machine; `soft`: by the code for processors whose doubles are software."""
    flags = ["-O2", f"-I{HERE}", f"-DSLOTS={slots}", *(["-DDTSA_SOFT_DOUBLES"] if soft else [])]
    program = compile_program(tool("gcc", "gcc"), directory / "flight", [HERE / "flight.c", *sources()], flags)
    return _read_flights(_run([str(program)]))


def fly_on_cortex(
    directory: Path, slots: int = 200, metered: bool = True, more: Sequence[str] = ()
) -> list[EmbeddedFlight]:
    """The same flights on a Cortex-M4F in QEMU; `metered` counts stack and instructions of each call, slowly.

    :raises NotHere: where compiler or QEMU are missing.
    """
    flags = [*CORTEX, "-O2", f"-I{HERE}", f"-DSLOTS={slots}", *(["-DMETERED"] if metered else []), *more]
    return _read_flights(_run_on_cortex(directory, [HERE / "flight.c", *sources()], flags, metered))


def fly_app_on_cortex(directory: Path, slots: int = 200, sample: bool = False) -> list[BoardCosts]:
    """The app's loop there, with 12 agents and with as many as it is made for.

    A `sample` is that swarm with ``lease`` alone. Of each flight `slots` count, from when the app steers.
    """
    files = [HERE / "board_cost.c", *(path for path in _app_sources() if path.name != "app.c")]
    flags = [*CORTEX, "-Os", f"-DSLOTS={slots}", *(["-DSAMPLE"] if sample else []), *_app_folders()]
    text = _run_on_cortex(directory, files, flags, True)
    # Bytes of stack of appMain itself, which the program looks at from below.
    out = directory / "frame.o"
    flags = [*CORTEX, "-Os", "-c", "-fstack-usage", *_app_folders()]
    compile_program(_compiler(), out, [_ONBOARD / "app.c"], flags, links=())
    usage = [line.split("\t") for line in out.with_suffix(".su").read_text().splitlines()]
    frame = next(int(row[1]) for row in usage if row[0].endswith(":appMain"))
    costs = []
    for line in text.splitlines():
        policy, *words = line.split()
        agents, counted, stack, *values = map(int, words)
        pairs = {kind: (values[2 * i], values[2 * i + 1]) for i, kind in enumerate(TURNS)}
        costs.append(BoardCosts(policy, agents, counted, stack + frame, pairs, values[-1]))
    return costs


def check_board_program(directory: Path) -> None:
    """Compile ``board_cost.c`` by this machine's compiler, without code.

    :raises DtsaError: what is wrong with it.
    """
    flags = ["-std=gnu11", "-DSLOTS=1", "-fsyntax-only", "-Werror", *_app_folders()]
    compile_program(tool("gcc", "gcc"), directory / "none", [HERE / "board_cost.c"], flags, links=())


def fused(directory: Path, library: Path = LIBRARY) -> dict[str, int]:
    """Fused multiplications and additions where a firmware's flags allow them, by file that has any."""
    counts = {}
    for path in sources(library):
        out = directory / f"{path.parent.name}-{path.stem}.s"
        compile_program(_compiler(), out, [path], [*CORTEX, "-O2", *FUSING, "-S"], library, links=())
        count = len(re.findall(r"^\s+vfn?m[as]", out.read_text(), re.MULTILINE))
        if count:
            counts[path.name] = count
    return counts


def _compiler() -> str:
    return tool("arm-none-eabi-gcc", "gcc-arm-none-eabi libnewlib-arm-none-eabi")


def _run_on_cortex(directory: Path, files: list[Path], flags: list[str], metered: bool) -> str:
    """Output of a program in QEMU."""
    qemu = tool("qemu-system-arm", "qemu-system-arm")
    board = ["-nostartfiles", "--specs=rdimon.specs", f"-T{HERE / 'mps2.ld'}", *IN_PARTS]
    program = compile_program(_compiler(), directory / "board.elf", [*files, HERE / "mps2.c"], [*flags, *board])
    command = [qemu, "-M", "mps2-an386", "-display", "none", "-monitor", "none", "-serial", "none"]
    command += ["-semihosting-config", "enable=on,target=native", "-kernel", str(program)]
    return _run([*command, *(["-icount", "shift=5"] if metered else [])])  # 32 ns an instruction, see mps2.c


def _sizes(directory: Path, files: list[Path], level: str) -> dict[Path, tuple[int, int]]:
    """Bytes of code with constants, and of RAM, of C files compiled for a Cortex-M4F."""
    size = tool("arm-none-eabi-size", "binutils-arm-none-eabi")
    sizes = {}
    for path in files:
        out = directory / f"{path.parent.name}-{path.stem}.o"
        compile_program(_compiler(), out, [path], [*CORTEX, level, "-c", *_app_folders()], links=())
        text, data, bss = map(int, _run([size, str(out)]).splitlines()[1].split()[:3])
        sizes[path] = text if level == "-O2" else text + data, data + bss
    return sizes


def _app_sources() -> list[Path]:
    from dtsa_bench.crazyflies.peer_lab.app import read_app

    return list(dict.fromkeys(path.resolve() for path in (*read_app(str(_ONBOARD)).sources, *sources())))


def _app_folders() -> list[str]:
    from dtsa_bench.crazyflies.peer_lab.app import read_app
    from dtsa_bench.crazyflies.peer_lab.compiling import FIRMWARE

    return [f"-I{path}" for path in (HERE, _ONBOARD, FIRMWARE, *read_app(str(_ONBOARD)).include)]


def _run(command: list[str], limit_s: float = 600.0) -> str:
    done = subprocess.run(command, capture_output=True, text=True, check=False, timeout=limit_s)
    if done.returncode:
        raise DtsaError(f"{Path(command[0]).name}: exit code {done.returncode}: {done.stderr.strip()[-500:]}")
    return done.stdout or done.stderr  # QEMU's semihosting writes to the terminal's error output


def _read_flights(text: str) -> list[EmbeddedFlight]:
    flights = []
    for line in text.splitlines():
        policy, agents, digest, memory, *words = line.split()
        values = list(map(int, words))
        costs = {call: (values[3 * i], values[3 * i + 1], values[3 * i + 2]) for i, call in enumerate(CALLS) if values}
        flights.append(EmbeddedFlight(policy, int(agents), digest, int(memory), costs))
    return flights
