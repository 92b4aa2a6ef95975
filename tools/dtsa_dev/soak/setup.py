"""Set-ups that are interrupted and killed at random moments: the plain command again goes on and ends well."""

from __future__ import annotations

import os
import random
import shutil
import signal
import subprocess
import time
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any

from dtsa_bench.experiments.batch.task import Row

from .checks import met
from .item import Item, Soak

_ROOT = Path(__file__).resolve().parents[3]
_CHAINS = 5  # of 10 interruptions by Ctrl-C and 2 by SIGKILL each
_FIRST = "from nothing"  # each chain of interruptions begins so, in a checkout of its own
_OTHERS = (("packages", 5), ("kernels", 3), ("messages", 1))  # what is missing, and how often in a chain
_KILLS = ("packages", "kernels")  # in each chain; SIGKILL
_TAKES_S = {_FIRST: 80.0, "packages": 10.0, "kernels": 12.0, "messages": 40.0}  # a first guess
_PATIENCE_S = 900.0
_SWAPPED = ("setuptools", "wheel", "colcon_core", "numpy", "pandas", "pyarrow")
_SMOKE = "import dtsa_msgs.msg, pandas, pyarrow, rclpy, setuptools; import dtsa_agent.air.udp._socket"
_OURS = ("_PREFIX_PATH", "LD_LIBRARY_PATH", "PYTHONPATH", "VIRTUAL_ENV", "_ROS_WHEELS_BOOTSTRAP_COMPLETE")


def _items() -> Iterator[Item]:
    for chain in range(1, _CHAINS + 1):
        seconds = 2 * _TAKES_S[_FIRST] + sum(3 * count * _TAKES_S[what] for what, count in _OTHERS)
        yield Item(f"ten by Ctrl-C, two by SIGKILL: {chain}", {"whole": True}, chain, seconds)
    yield Item("one of each, from nothing", {"whole": False}, 100, 200.0, sample=True)


def _trials(item: Item, draw: random.Random) -> list[tuple[str, int]]:
    """What is interrupted, and by which signal; the first from nothing, the rest in random order."""
    counts = _OTHERS if item.settings["whole"] else ()
    rest = [(what, signal.SIGINT) for what, count in counts for _ in range(count)]
    rest += [(what, signal.SIGKILL) for what in (_KILLS if counts else _KILLS[:1])]
    draw.shuffle(rest)
    return [(_FIRST, signal.SIGINT), *rest]


class _Checkout:
    """A copy of this checkout in which nothing is set up."""

    def __init__(self, place: Path) -> None:
        self.place = place
        ignored = shutil.ignore_patterns("__pycache__", "*.so", "*.egg-info", "test")
        for name in ("tools", "requirements", "src"):
            shutil.copytree(_ROOT / name, place / name, ignore=ignored)
        kept = {name: value for name, value in os.environ.items() if not name.endswith(_OURS)}
        path = [part for part in kept["PATH"].split(os.pathsep) if not Path(part).is_relative_to(_ROOT)]
        self.environment = kept | {"PATH": os.pathsep.join(path)}

    def start(self, *words: str) -> subprocess.Popen[str]:
        """A command of the checkout, in a process group of its own."""
        with (self.place / f"said-{words[0]}.txt").open("w+") as said:
            command = [str(self.place / "tools" / "dtsa"), *words]
            return subprocess.Popen(
                command, env=self.environment, start_new_session=True, stdout=said, stderr=said, text=True
            )

    def said(self, command: str) -> str:
        return (self.place / f"said-{command}.txt").read_text(encoding="utf-8")

    def ends_well(self, *words: str) -> None:
        code = self.start(*words).wait(_PATIENCE_S)
        met(code == 0, f"`{words[0]}` ends with {code}: {self.said(words[0]).strip()[-400:]}")

    def running(self) -> list[int]:
        """Processes that the steps of its set-up have started."""
        mark, found = f"DTSA_SETUP_OF={self.place}".encode(), []
        for entry in Path("/proc").glob("[0-9]*"):
            with suppress(OSError):  # it has ended
                found += [int(entry.name)] * (mark in (entry / "environ").read_bytes().split(b"\0"))
        return found

    def make_missing(self, what: str) -> None:
        """Makes something that the next set-up has to do.

        :param what: a key of _TAKES_S.
        """
        agent = self.place / "src" / "dtsa_agent" / "dtsa_agent"
        if what == _FIRST:
            for name in (".venv", "build", "install"):
                shutil.rmtree(self.place / name, ignore_errors=True)
        elif what == "packages":
            self._make_older()
        elif what == "kernels":
            with (agent / "libdtsa" / "frame.c").open("a") as file:
                file.write("/* changed */\n")
        elif what == "messages":
            with (self.place / "src" / "dtsa_msgs" / "msg" / "Slot.msg").open("a") as file:
                file.write("# changed\n")

    def _make_older(self) -> None:
        """Makes installed packages look like those of other versions: pip swaps them all."""
        for name in _SWAPPED:
            (info,) = self.place.glob(f".venv/lib/python3.*/site-packages/{name}-*.dist-info")
            version = info.name.removesuffix(".dist-info").partition("-")[2]
            for file, before, after in (
                ("METADATA", f"\nVersion: {version}\n", f"\nVersion: {version}.dev1\n"),
                ("RECORD", info.name, f"{name}-{version}.dev1.dist-info"),
            ):
                text = (info / file).read_text(encoding="utf-8")
                (info / file).write_text(text.replace(before, after), encoding="utf-8")
            info.rename(info.with_name(f"{name}-{version}.dev1.dist-info"))
        for name in ("ros", "runtime"):
            (self.place / ".venv" / ".dtsa" / name).unlink()


def _run(item: Item, directory: Path) -> dict[str, Any]:
    draw, checkout, takes = random.Random(item.name), _Checkout(directory / "checkout"), dict(_TAKES_S)
    done = []
    for what, number in _trials(item, draw):
        trial = _interrupt(checkout, what, number, takes, draw)
        trial |= _again(checkout, draw.random() < 0.3)
        checkout.ends_well("shell", "-c", f'python3 -c "{_SMOKE}"')
        left = [str(path) for path in (checkout.place / ".venv").rglob("~*")]
        met(not left, f"after {trial} there is still {left}")
        done.append(trial)
    return {"interruptions": done}


def _again(checkout: _Checkout, both: bool) -> dict[str, Any]:
    """The plain command after an interruption.

    :param both: another one in the same moment, which must end well, too.
    """
    begin = time.monotonic()
    other = checkout.start("setup") if both else None
    try:
        checkout.ends_well("simulate", "--agents", "4", "--policy", "lease")
        took = time.monotonic() - begin
        if other is not None:
            met(other.wait(_PATIENCE_S) == 0, f"the other set-up at the same time: {checkout.said('setup')[-400:]}")
    finally:
        if other is not None and other.poll() is None:
            other.terminate()
            other.wait(_PATIENCE_S)
    return {"both": both, "again_s": round(took, 1)}


def _interrupt(
    checkout: _Checkout, what: str, number: int, takes: dict[str, float], draw: random.Random
) -> dict[str, Any]:
    """Interrupts a set-up that has something to do, at a random moment of it.

    :param takes: s that each kind of work takes, by what is missing; lowered where the set-up was faster.
    """
    while True:
        checkout.make_missing(what)
        after = draw.uniform(0.0, takes[what])
        process = checkout.start("setup")
        try:
            met(process.wait(after) == 0, f"an uninterrupted set-up fails: {checkout.said('setup').strip()[-400:]}")
        except subprocess.TimeoutExpired:
            break
        takes[what] = after  # it was through before the signal came
    os.killpg(process.pid, number)
    code, said = process.wait(_PATIENCE_S), checkout.said("setup")
    if number == signal.SIGINT:
        met(code in (130, -signal.SIGINT), f"{what}: Ctrl-C after {after:.2f} s ends it with {code}: {said[-400:]}")
        met("Traceback" not in said, f"{what}: a traceback after {after:.2f} s: {said[-400:]}")
        met(not checkout.running(), f"{what}: Ctrl-C after {after:.2f} s leaves processes")
    return {"missing": what, "signal": signal.Signals(number).name, "after_s": round(after, 2), "during": _step(said)}


def _step(said: str) -> str:
    """The step of a set-up that was under way when it ended."""
    begun = [line.removesuffix(" ...") for line in said.splitlines() if line.endswith(" ...")]
    if not begun or f"{begun[-1]} ... done" in said:
        return "between steps"
    return next((step for step in ("virtual environment", "packages", "workspace") if step in begun[-1]), begun[-1])


def _figures(rows: Sequence[Row]) -> dict[str, Any]:
    trials = [trial for row in rows for trial in row["summary"]["interruptions"]]

    def count(key: Callable[[dict[str, Any]], object]) -> dict[str, int]:
        return {str(name): number for name, number in sorted(Counter(map(key, trials)).items(), key=str)}

    return {
        "interruptions that ended well": len(trials),
        "by signal": count(lambda trial: trial["signal"]),
        "by what was missing": count(lambda trial: trial["missing"]),
        "by the step they hit": count(lambda trial: trial["during"]),
        "with another set-up at the same time": sum(trial["both"] for trial in trials),
        "slowest command again, s": max((trial["again_s"] for trial in trials), default=None),
    }


SOAK = Soak(
    "setup",
    "A set-up that Ctrl-C or SIGKILL ends at any moment is finished by the same command again.",
    tuple(_items()),
    _run,
    _figures,
)
