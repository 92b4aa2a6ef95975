"""Tries every command of an installed `dtsa` where there is no ROS."""

from __future__ import annotations

import json
import secrets
import shutil
import socket
import urllib.request
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from machine import layout

from .running import Done, Runner

FLIGHTS = Path(__file__).resolve().parent / "flights.py"
AGENTS = 3
NEEDS_ROS = "source an installation of ROS 2 Jazzy"
IMPORT = "import time; t = time.perf_counter(); import dtsa; print(time.perf_counter() - t, dtsa.__version__)"
_SWEEP = """\
title: smoke
text: smoke
base: {agents: 6, timeout_s: 5}
axes: {policy: [tdma, dtsa], loss: [0.0, 0.1]}
seeds: 2
"""
_ENTRY_POINTS = (
    "import json, importlib.metadata as m; "
    "print(json.dumps([e.name for e in m.distribution('dtsa').entry_points if e.group == 'console_scripts']))"
)


@dataclass(frozen=True)
class Installed:
    """An installed `dtsa`, and how it is started.

    :param dtsa: words that start the command.
    :param python: words that start its Python.
    :param environment: what both find there.
    :param slot_ms: ms, length of the slots of agents over UDP; the machine may be busy.
    :param jobs: processes of a sweep; a simulated processor starts none.
    """

    dtsa: tuple[str, ...]
    python: tuple[str, ...]
    environment: dict[str, str]
    slot_ms: int = 20
    jobs: int = 2


@dataclass
class Trial:
    """Tries commands in a directory, and keeps what was found.

    :param runner: runs programs.
    :param installed: what is tried.
    :param directory: an empty one, outside of the checkout.
    """

    runner: Runner
    installed: Installed
    directory: Path
    failures: list[str] = field(default_factory=list)
    count: int = 0

    def python(self, *words: str | Path) -> Done:
        """Runs the environment's Python."""
        return self.runner.run([*self.installed.python, *words], self.directory, self.installed.environment)

    def dtsa(self, *words: str, code: int = 0, says: str = "", makes: str = "", **more: Any) -> Done:
        """Runs a command and judges it.

        :param code: what it must end with; with 2 it must say why in one line.
        :param says: what must stand in its output.
        :param makes: a file that must be there then.
        :param more: for :meth:`Runner.run`.
        """
        done = self.runner.run([*self.installed.dtsa, *words], self.directory, self.installed.environment, **more)
        self.judge(done, words, code, says, makes)
        return done

    def judge(self, done: Done, words: Sequence[str], code: int, says: str = "", makes: str = "") -> None:
        """Notes whether a command did what it should; see :meth:`dtsa`."""
        command = " ".join(("dtsa", *words))
        if done.code != code:
            self.note(False, f"{command}: {done.reason()}")
        elif code == 2 and done.stderr.count("\n") != 1:
            self.note(False, f"{command}: {done.stderr.count(chr(10))} lines in place of one")
        elif says not in done.stdout + done.stderr:
            self.note(False, f"{command}: does not say {says!r}")
        else:
            self.note(not makes or (self.directory / makes).exists(), f"{command}: {makes} is missing")

    def note(self, good: bool, failure: str) -> None:
        """Counts something that was looked at.

        :param failure: what to say if it was not good.
        """
        self.count += 1
        if not good:
            self.failures.append(failure)

    def imported(self, version: str) -> float:
        """Smallest time of five imports of `dtsa`, s.

        :param version: that it must have.
        """
        times = []
        for _ in range(5):
            done = self.python("-c", IMPORT)
            seconds, _, found = done.stdout.strip().partition(" ")
            if done.code:
                self.note(False, f"import dtsa: {done.reason()}")
                return 0.0
            self.note(found == version, f"import dtsa: version {found} in place of {version}")
            times.append(float(seconds))
        return min(times)

    def flown(self) -> str:
        """The digest of the flights."""
        done = self.python(FLIGHTS)
        self.note(done.code == 0, f"flights: {done.reason()}")
        return str(json.loads(done.stdout)["all"]) if done.code == 0 else ""

    def without_extras(self, version: str, flown: Path | None = None) -> None:
        """All commands, with what `pip install dtsa` alone brings along.

        :param version: what it must say.
        :param flown: where the bags of agents are that flew elsewhere; None: they fly here.
        """
        self.dtsa("--version", says=f"dtsa {version}\n")
        done = self.python("-c", _ENTRY_POINTS)
        self.note(done.stdout.strip() == '["dtsa"]', f"programs on the PATH: {done.stdout.strip()}")
        self.dtsa("simulate", "--agents", "6", "--policy", "lease", "--json", says='"policy": "lease"')
        (self.directory / "sweep.yaml").write_text(_SWEEP, encoding="utf-8")
        jobs = str(self.installed.jobs)
        self.dtsa("sweep", "--file", "sweep.yaml", "--out", "swept", "--jobs", jobs, makes="swept/report.html")
        self.dtsa("new-plugin", "smoke-policy", "--out", "plug-in", makes="plug-in/sweep.yaml")
        for shell in ("bash", "zsh"):
            self.dtsa("completion", shell, says="simulate")
        if flown is None:
            self.on_a_network()
        else:
            for k in range(1, AGENTS + 1):
                shutil.copytree(flown / f"cf{k}", self.directory / f"cf{k}")
        self.dtsa("merge", *(f"cf{k}" for k in range(1, AGENTS + 1)), "--out", "flight", makes="flight/bag")
        self.dtsa("verify", "flight")
        self.dtsa("losses", "flight", "--out", "losses.json", makes="losses.json")
        losses = ("--agents", str(AGENTS), "--slot-ms", str(self.installed.slot_ms), "--losses", "losses.json")
        self.dtsa("simulate", *losses, "--timeout-s", "3", "--json", says='"policy"')
        self.dtsa("report", "flight", makes="flight/report.html")
        self.recovered()
        for words, extra in (
            (("export", "flight"), "tables"),
            (("view", "flight"), "view"),
            (("sniff", "--air", "serial", "--device", "x", "--no-seal"), "serial"),
            (("sweep", "--file", "sweep.yaml", "--out", "far", "--cluster", "tcp://127.0.0.1:1"), "cluster"),
        ):
            self.dtsa(*words, code=2, says=f"pip install 'dtsa[{extra}]'")
        self.dtsa("fake-crazyflie", "--count", "1", until="udp://")
        for words in (("demo",), ("fly", "--out", "flown"), ("replay", "flight")):
            self.dtsa(*words, code=2, says=NEEDS_ROS)
        shutil.copy(layout.SOURCES / "dtsa_agent" / "config" / "swarm_simulated.yaml", self.directory / "swarm.yaml")
        self.dtsa("bridge", "--config", "swarm.yaml", code=2, says="pip install 'dtsa[crazyflie]'")

    def on_a_network(self) -> None:
        """Agents on the loopback interface, and one who listens."""
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
            probe.bind(("", 0))
            group = f"239.68.84.83:{probe.getsockname()[1]}"
        air = ["--interface", "lo", "--group", group, "--agents", str(AGENTS), "--slot-ms", str(self.installed.slot_ms)]
        air += ["--auth-session", "1", "--duration-s", str(self.installed.slot_ms * 0.4)]
        commands = [("agent", "--id", str(k), *air, "--out", f"cf{k}") for k in range(1, AGENTS + 1)]
        commands.append(("sniff", *air, "--out", "sniffed"))
        environment = {**self.installed.environment, "DTSA_AUTH_KEY": secrets.token_hex(32)}
        words = [[*self.installed.dtsa, *command] for command in commands]
        done = self.runner.run_together(words, self.directory, environment)
        for k, (command, each) in enumerate(zip(commands, done, strict=True), 1):
            listens = k > AGENTS  # what it misses looks like a broken rule: it then ends with 1
            code = each.code if listens and each.code == 1 else 0
            self.judge(each, command, code, makes="sniffed/sniffed.mcap" if listens else f"cf{k}/cf{k}.mcap")

    def recovered(self) -> None:
        """A bag that breaks off."""
        if not (self.directory / "flight" / "bag").exists():
            return
        shutil.copytree(self.directory / "flight" / "bag", self.directory / "cut")
        (self.directory / "cut" / "metadata.yaml").unlink()
        path = next((self.directory / "cut").glob("*.mcap"))
        with path.open("r+b") as file:
            file.truncate(path.stat().st_size * 2 // 3)
        self.dtsa("recover", "cut", "--out", "saved", makes="saved")

    def with_extras(self) -> None:
        """What the extras are for."""
        self.dtsa("export", "flight", "--out", "parquet", makes="parquet")
        self.dtsa("export", "flight", "--to", "csv", "--tables", "slots", "--out", "csv", makes="csv/slots.csv")
        pages: list[int] = []

        def look(said: str) -> None:
            with urllib.request.urlopen(said.split()[0], timeout=20) as page:
                pages.append(len(page.read()))

        self.dtsa("view", "flight", until="\n", then=look)
        self.note(bool(pages) and pages[0] > 1000, "dtsa view: the page is not there")
        self.dtsa("view", code=2, says=NEEDS_ROS)
        done = self.python("-c", "import dtsa; print(len(dtsa.simulate(agents=4, timeout_s=3).slots))")
        self.note(done.code == 0, f"tables of a flight: {done.reason()}")
        done = self.python("-c", "import dtsa; print(len(dtsa.env.parallel_env(agents=4).reset(seed=1)[0]))")
        self.note(done.code == 0, f"an environment for learning: {done.reason()}")
        done = self.python("-c", "import distributed")
        self.note(done.code == 0, f"import distributed: {done.reason()}")
