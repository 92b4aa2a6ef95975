"""libdtsa on a microcontroller: the same flights on this machine and on a simulated Cortex-M4F, and what calls cost."""

from __future__ import annotations

import re
import subprocess
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from dtsa_agent.core.errors import DtsaError

from .library import HERE, LIBRARY, compile_program, sources, tool

CALLS = ("slot", "command", "hear", "end")  # in the order of meter.h
#: Flags for the processor of a Crazyflie.
CORTEX = ("-mcpu=cortex-m4", "-mthumb", "-mfpu=fpv4-sp-d16", "-mfloat-abi=hard")
#: Flags of a firmware that fuses multiplications and additions where it may.
FUSING = ("-std=gnu11", "-O3", "-ffp-contract=fast", "-fno-math-errno")
IN_PARTS = ("-ffunction-sections", "-fdata-sections", "-Wl,--gc-sections")
_LIMIT_S = 120.0


@dataclass(frozen=True, slots=True)
class Cost:
    """What one kind of call takes."""

    mean: int  # instructions
    most: int  # instructions
    stack: int  # bytes


@dataclass(frozen=True, slots=True)
class Flight:
    """One of the flights of ``flight.c``."""

    policy: str
    agents: int
    digest: str  # of all frames, decisions, tables and commands
    memory: int  # bytes of an agent
    costs: dict[str, Cost]  # by call; empty where they are not measured


def fly_here(directory: Path, slots: int = 200, compiler: str = "gcc", soft: bool = False) -> list[Flight]:
    """The flights on this machine.

    :param directory: for the program.
    :param slots: of each flight.
    :param compiler: name of the C compiler.
    :param soft: by the code for processors whose doubles are software.
    """
    flags = ["-O2", f"-I{HERE}", f"-DSLOTS={slots}", *(["-DDTSA_SOFT_DOUBLES"] if soft else [])]
    program = compile_program(tool(compiler, compiler), directory / "flight", _files(), flags)
    return _read(run_program([str(program)]))


def fly_on_cortex(directory: Path, slots: int = 200, metered: bool = True, more: Sequence[str] = ()) -> list[Flight]:
    """The flights on a Cortex-M4F in QEMU.

    :param directory: for the program, ``flight.elf``.
    :param slots: of each flight.
    :param metered: count stack and instructions of each call, which takes a while.
    :param more: flags of the compiler.
    :raises NotHere: where compiler or QEMU are missing.
    """
    board = [*qemu(), *(["-icount", "shift=5"] if metered else [])]  # 32 ns an instruction, see mps2.c
    return _read(run_program([*board, "-kernel", str(build_for_cortex(directory, slots, metered, more))]))


def build_for_cortex(directory: Path, slots: int = 200, metered: bool = True, more: Sequence[str] = ()) -> Path:
    """The program for the board.

    :param directory: where it is put.
    :param slots: of each flight.
    :param metered: with counters of stack and instructions.
    :param more: flags of the compiler.
    """
    compiler = tool("arm-none-eabi-gcc", "gcc-arm-none-eabi libnewlib-arm-none-eabi")
    board = ["-nostartfiles", "--specs=rdimon.specs", f"-T{HERE / 'mps2.ld'}", f"-I{HERE}", f"-DSLOTS={slots}"]
    board += ["-DMETERED"] if metered else []
    files = [*_files(), HERE / "mps2.c"]
    return compile_program(compiler, directory / "flight.elf", files, [*CORTEX, "-O2", *IN_PARTS, *board, *more])


def code_size(directory: Path) -> dict[str, int]:
    """Bytes of code and constants for a Cortex-M4F, by part of libdtsa.

    :param directory: for object files.
    """
    compiler = tool("arm-none-eabi-gcc", "gcc-arm-none-eabi libnewlib-arm-none-eabi")
    size = tool("arm-none-eabi-size", "binutils-arm-none-eabi")
    sums: dict[str, int] = {}
    for path in sources():
        out = directory / f"{path.parent.name}-{path.stem}.o"
        compile_program(compiler, out, [path], [*CORTEX, "-O2", "-c"], links=())
        text = run_program([size, str(out)]).splitlines()[1].split()[0]
        part = (
            "avoiders" if path.parent.name == "avoider" else "policy lease" if path.parent.name == "lease" else "rest"
        )
        sums[part] = sums.get(part, 0) + int(text)
    return sums


def fused(directory: Path, library: Path = LIBRARY) -> dict[str, int]:
    """Fused multiplications and additions by file where a firmware's flags allow them; files without any are left out.

    :param directory: for assembly.
    :param library: folder of libdtsa.
    """
    compiler = tool("arm-none-eabi-gcc", "gcc-arm-none-eabi libnewlib-arm-none-eabi")
    counts = {}
    for path in sources(library):
        out = directory / f"{path.parent.name}-{path.stem}.s"
        compile_program(compiler, out, [path], [*CORTEX, "-O2", *FUSING, "-S"], library, links=())
        count = len(re.findall(r"^\s+vfn?m[as]", out.read_text(), re.MULTILINE))
        if count:
            counts[path.name] = count
    return counts


def _files() -> list[Path]:
    return [HERE / "flight.c", *sources(LIBRARY)]


def qemu() -> list[str]:
    """The command that starts the board, without a program.

    :raises NotHere: if there is no QEMU.
    """
    program = tool("qemu-system-arm", "qemu-system-arm")
    board = ["-M", "mps2-an386", "-display", "none", "-monitor", "none", "-serial", "none"]
    return [program, *board, "-semihosting-config", "enable=on,target=native"]


def run_program(command: list[str], limit_s: float = _LIMIT_S) -> str:
    """What a program prints.

    :param command: it, and its arguments. :param limit_s: s, for which it may run.
    :raises DtsaError: if it fails.
    """
    done = subprocess.run(command, capture_output=True, text=True, check=False, timeout=limit_s)
    if done.returncode:
        raise DtsaError(f"{Path(command[0]).name}: exit code {done.returncode}: {done.stderr.strip()[-500:]}")
    return done.stdout or done.stderr  # QEMU's semihosting writes to the terminal's error output


def _read(text: str) -> list[Flight]:
    flights = []
    for line in text.splitlines():
        policy, agents, digest, memory, *numbers = line.split()
        costs = {name: Cost(*map(int, numbers[3 * i : 3 * i + 3])) for i, name in enumerate(CALLS) if numbers}
        flights.append(Flight(policy, int(agents), digest, int(memory), costs))
    return flights


def table(here: list[Flight], cortex: list[Flight], code: dict[str, int]) -> str:
    """What docs/evidence/embedded.md shows, as Markdown.

    :param here: the flights on this machine.
    :param cortex: the same on the Cortex-M4F.
    :param code: bytes by part.
    """
    lines = ["| policy | N | RAM of an agent | stack | slot, mean / most | command | hear | end | digest |"]
    lines.append("|---" * 9 + "|")
    for flight, other in zip(cortex, here, strict=True):
        stack = max(cost.stack for cost in flight.costs.values())
        calls = " | ".join(f"{cost.mean:,} / {cost.most:,}" for cost in flight.costs.values())
        same = "as here" if flight.digest == other.digest else f"NOT {other.digest}"
        lines.append(
            f"| {flight.policy} | {flight.agents} | {flight.memory:,} B | {stack:,} B | {calls} | "
            f"{flight.digest}, {same} |"
        )
    sizes = ", ".join(f"{part} {bytes_:,} B" for part, bytes_ in sorted(code.items()))
    return "\n".join([*lines, "", f"Code and constants: {sizes}."])
