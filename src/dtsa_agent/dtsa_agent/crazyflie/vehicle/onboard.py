"""What a connected Crazyflie offers beside its flight: parameters, log blocks, the memory for trajectories."""

from __future__ import annotations

import contextlib
import math
import threading
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from dtsa_agent.crazyflie.links.link import Link
from dtsa_agent.crazyflie.motion.trajectories import Trajectory

UPLOAD_S = 10.0  # longest time for an upload
ANSWER_S = 0.5  # longest wait for the answer to a definition
DEFINITIONS_SENT = 3  # times, until it is answered
DEFINE = 6  # first byte of the packet that defines a trajectory, and of its answer
FLOATS = frozenset({"float", "FP16", "double"})
LOG_PERIOD_MS = (10, 2550)

LogCallback = Callable[[int, Mapping[str, float]], None]


@dataclass(frozen=True, slots=True)
class Parameter:
    """One parameter of the firmware."""

    name: str  # group.name
    kind: str  # the C type
    read_only: bool
    value: float  # an int where the type is one

    @property
    def is_float(self) -> bool:
        """Whether its values need not be whole."""
        return self.kind in FLOATS

    def problem(self, value: object) -> str:
        """Why it cannot have a value; empty if it can."""
        if self.read_only:
            return f"{self.name} is read-only"
        if isinstance(value, bool) or not isinstance(value, (int, float)) or not math.isfinite(value):
            return f"{self.name}: {value!r} is not a number"
        if self.is_float:
            return ""
        bits = int("".join(filter(str.isdigit, self.kind)))
        low, high = (0, 2**bits - 1) if self.kind.startswith("u") else (-(2 ** (bits - 1)), 2 ** (bits - 1) - 1)
        if value != int(value) or not low <= value <= high:
            return f"{self.name}: {value!r} is not a whole number from {low} to {high}"
        return ""


class _Packed:
    """Bytes that are written to the memory as they are."""

    def __init__(self, data: bytes) -> None:
        self._data = data

    def pack(self) -> bytes:
        return self._data


class Onboard:
    """Parameters, log blocks and trajectories of one Crazyflie.

    :param link: its link; what is asked of it goes through its worker, behind its orders.
    """

    def __init__(self, link: Link) -> None:
        self._link = link
        self._blocks: dict[str, Any] = {}
        self.trajectories: dict[int, Trajectory] = {}  # in the memory, by their numbers
        self._defined = threading.Event()
        self._refusal = 0

    # -- parameters -------------------------------------------------------------------------------------------------
    def parameters(self) -> dict[str, Parameter]:
        """All parameters by their names, as far as they were read."""
        cf = self._link.crazyflie
        if cf is None:
            return {}
        found = {}
        for group, elements in dict(cf.param.toc.toc).items():
            for name, element in dict(elements).items():
                text = cf.param.values.get(group, {}).get(name)
                if text is None:
                    continue
                full = f"{group}.{name}"
                value = self._link.robot.firmware_params.get(full)  # was set a moment ago
                if value is None:
                    value = float(text) if element.ctype in FLOATS else int(text)
                found[full] = Parameter(full, element.ctype, element.access == element.RO_ACCESS, value)
        return found

    @property
    def settable(self) -> bool:
        """Whether parameters can be set now: it is connected, and its values are known."""
        cf = self._link.crazyflie
        return cf is not None and bool(cf.param.is_updated)

    def set_parameter(self, name: str, value: float) -> None:
        """Set a parameter that exists to a value that it can have; does not wait."""

        def send(cf: Any) -> None:
            parameters = cf.param
            if parameters.is_updated:  # else cflib would keep the worker waiting, and all orders with it
                with contextlib.suppress(KeyError, AttributeError):  # the link has just ended
                    parameters.set_value(name, value)

        self._link.order(send, background=True)

    # -- log blocks -------------------------------------------------------------------------------------------------
    def add_log(self, name: str, period_ms: int, variables: Sequence[str], callback: LogCallback) -> str:
        """Log variables; why not, or an empty text.

        The firmware ends it with a gap of the link of a second, and with the connection.

        :param name: of the block, by which it is ended.
        :param period_ms: 10 to 2550, in steps of 10.
        :param variables: names, `group.name`.
        :param callback: called with the Crazyflie's time (ms) and the values by name, in a thread of cflib's.
        """
        from cflib.crazyflie.log import LogConfig

        cf = self._link.crazyflie
        if cf is None:
            return f"{self._link.robot.name} is not connected"
        if name in self._blocks:
            return f"{name} is logged already"
        if not variables or not LOG_PERIOD_MS[0] <= period_ms <= LOG_PERIOD_MS[1]:
            return f"{name}: {len(variables)} variables every {period_ms} ms"
        block = LogConfig(name, period_ms)
        try:
            for variable in variables:
                block.add_variable(variable)
            cf.log.add_config(block)
        except KeyError as error:
            return f"{name}: the firmware does not log {error}"
        except AttributeError as error:
            return f"{name}: {error}"
        block.data_received_cb.add_callback(lambda stamp, values, config: callback(stamp, values))
        self._blocks[name] = block

        def start(connected: Any) -> None:
            assert connected.log is not None  # logs need their answers: nothing that goes past a stuck packet
            block.start()

        self._link.order(start, background=True)
        return ""

    def remove_log(self, name: str) -> str:
        """End a log; why not, or an empty text."""
        block = self._blocks.pop(name, None)
        if block is None:
            return f"{name} is not logged"

        def end(connected: Any) -> None:
            assert connected.log is not None
            block.delete()

        self._link.order(end, background=True)
        return ""

    # -- trajectories -----------------------------------------------------------------------------------------------
    def upload(self, trajectory: Trajectory) -> str:
        """Write a trajectory to the memory and define it; waits; why not, or an empty text."""
        for number in [n for n, other in self.trajectories.items() if other.overlaps(trajectory)]:
            del self.trajectories[number]
        self.trajectories.pop(trajectory.number, None)
        problem = self._write(trajectory) or self._define(trajectory)
        if not problem:
            self.trajectories[trajectory.number] = trajectory
        return problem

    def _write(self, trajectory: Trajectory) -> str:
        done = threading.Event()
        problems: list[str] = []

        def end(problem: str = "") -> None:
            if problem:
                problems.append(problem)
            done.set()

        def write(cf: Any) -> None:
            from cflib.crazyflie.mem import MemoryElement

            memories = cf.mem.get_mems(MemoryElement.TYPE_TRAJ)
            if not memories:
                end("it has no memory for trajectories")
                return
            memories[0].trajectory = [_Packed(trajectory.packed())]
            memories[0].write_data(
                lambda *_: end(),
                lambda *_: end("it did not take the trajectory"),
                start_addr=trajectory.begin,
            )

        self._link.order(write, background=True)
        if not done.wait(UPLOAD_S):
            return f"the upload was not over after {UPLOAD_S:g} s"
        return problems[0] if problems else ""

    def _define(self, trajectory: Trajectory) -> str:
        def define(cf: Any) -> None:
            pieces = len(trajectory.pieces)
            cf.high_level_commander.define_trajectory(trajectory.number, trajectory.begin, pieces, type=trajectory.kind)

        self._defined.clear()
        for _ in range(DEFINITIONS_SENT):
            self._link.order(define, background=True)
            if self._defined.wait(ANSWER_S):
                return f"it refuses the trajectory (error {self._refusal})" if self._refusal else ""
        return "it did not answer"

    def answered(self, code: int, result: int) -> None:
        """The firmware has answered an order; only definitions matter here.

        :param code: the order's first byte.
        :param result: 0, or the number of an error.
        """
        if code == DEFINE:
            self._refusal = result
            self._defined.set()

    def forget(self) -> None:
        """A new connection: the Crazyflie may have been switched on again."""
        self._blocks.clear()
        self.trajectories.clear()
