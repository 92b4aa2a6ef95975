"""How much longer frames are under way than an agent supposes: nobody can tell alone, two together can.

What agent i hears of j comes later than i expects by d + o_j - o_i, and what j hears of i by d + o_i - o_j: d is the
part of the way that nobody has thought of, o the offsets of their slots. So d is half the sum. Every agent says in its
datagrams how late it hears some of the others, in turn, and takes the median over all pairs that it is part of for d.
Without it everybody would move towards frames that seem late, and the slots of those that hear much would run away
from the slots of those that hear little.
"""

from __future__ import annotations

from bisect import bisect_left, insort
from collections.abc import Callable, Sequence

_SHARE = 64  # of which the estimate moves by a part with a frame: slowly, so that it does not follow the slots
_STEP_NS = 1_000_000

Peer = tuple[int, int]  # id, and how much later than expected it is heard, ns


class Delay:
    """What one agent knows of it.

    :param agent: own id.
    :param limit_ns: ns; what is off by more, either way, counts as this.
    :param peers: of those that it hears a datagram names so many.
    """

    __slots__ = ("_agent", "_hears", "_limit_ns", "_peers", "_said", "_sum_of", "_sums", "_turn", "error_ns")

    def __init__(self, agent: int, limit_ns: int, peers: int = 4) -> None:
        self._agent, self._limit_ns, self._peers = agent, limit_ns, peers
        self._hears: dict[int, int] = {}  # how much later than expected each other one is heard, ns
        self._said: dict[int, int] = {}  # how much later than expected each other one says to hear this one, ns
        self._sum_of: dict[int, int] = {}  # of both, where both are known: own slots that move change none
        self._sums: list[int] = []  # the same, ascending
        self._turn = 0
        #: How much longer frames are under way than supposed, ns.
        self.error_ns = 0

    def hear(self, sender: int, offset_ns: int, peers: Sequence[Peer]) -> None:
        """A frame was heard.

        :param sender: id.
        :param offset_ns: ns, how much later than expected.
        :param peers: whom its sender hears how late.
        """
        self._hears[sender] = self._limited(offset_ns)
        for peer, late_ns in peers:
            if peer == self._agent:
                self._said[sender] = self._limited(late_ns)
        if sender in self._said:
            self._pair(sender, self._hears[sender] + self._said[sender])
        sums = self._sums
        if not sums:
            return
        middle = len(sums) // 2
        step = (sums[middle] + sums[~middle]) // 4 - self.error_ns  # half the sum, the median over all pairs
        self.error_ns += min(max(step, -_STEP_NS), _STEP_NS) // _SHARE

    def _pair(self, peer: int, total: int) -> None:
        """The sum of a pair is known, or another one."""
        before = self._sum_of.get(peer)
        if before is not None:
            del self._sums[bisect_left(self._sums, before)]
        self._sum_of[peer] = total
        insort(self._sums, total)

    def tell(self, lately: Callable[[int], bool]) -> tuple[Peer, ...]:
        """What the next datagram says: the others in turn, the last one again, so that no two neighbours stay apart.

        :param lately: whether one was heard lately; the others are left out.
        """
        heard = sorted(filter(lately, self._hears))
        count = min(self._peers, len(heard))
        told = [heard[(self._turn + k) % len(heard)] for k in range(count)]
        self._turn += max(count - 1, min(count, 1))
        return tuple((peer, self._hears[peer]) for peer in told)

    def moved(self, by_ns: int) -> None:
        """The own slots have moved.

        :param by_ns: ns, later.
        """
        if not by_ns:
            return
        for values, by in ((self._hears, -by_ns), (self._said, by_ns)):
            for peer in values:
                values[peer] += by

    def reset(self) -> None:
        """Another time was taken over."""
        self._hears.clear()
        self._said.clear()
        self._sum_of.clear()
        self._sums.clear()

    def _limited(self, offset_ns: int) -> int:
        return min(max(offset_ns, -self._limit_ns), self._limit_ns)
