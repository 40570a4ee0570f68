"""Which example serves when: a function of seed, lane and step alone, so that a training can go on anywhere.

A *lane* is one place in the batches of all processes together. Every lane has a stream of its own: its examples get a
successor every `reuse` steps, and each step takes one of the newest `reuse`; so an example serves about that often.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True)
class Order:
    """Of `objects` objects; `lanes` of this process, out of `total` of all, each counted from 0."""

    objects: int
    lanes: Sequence[int]
    total: int
    reuse: int
    seed: int

    def newest(self, lane: int, step: int) -> int:
        """How many examples the lane has left behind at a step; lanes take turns."""
        return (step + lane % self.reuse) // self.reuse

    def chosen(self, lane: int, step: int) -> int:
        """The number of the example that the lane takes, among all that are ever drawn."""
        newest = self.newest(lane, step)
        rng = np.random.default_rng([self.seed, 1, lane, step])
        return self._number(lane, newest - int(rng.integers(min(self.reuse, newest + 1))))

    def living(self, step: int) -> set[int]:
        """The numbers of this process's examples that a step may take."""
        return {self._number(lane, index) for lane in self.lanes for index in self._of_lane(lane, step)}

    def arriving(self, start: int) -> Iterator[int]:
        """The numbers of this process's examples in the order in which they are first needed from a step on."""
        known: set[int] = set()
        step = start
        while True:
            for lane in self.lanes:
                for index in self._of_lane(lane, step):
                    number = self._number(lane, index)
                    if number not in known:
                        known.add(number)
                        yield number
            step += 1
            known &= self.living(step) | self.living(step - 1)

    def object_of(self, number: int) -> int:
        """Which object an example shows: each once an epoch, every epoch in another order."""
        epoch, place = divmod(number, self.objects)
        return int(np.random.default_rng([self.seed, 2, epoch]).permutation(self.objects)[place])

    def _of_lane(self, lane: int, step: int) -> range:
        newest = self.newest(lane, step)
        return range(max(newest - self.reuse + 1, 0), newest + 1)

    def _number(self, lane: int, index: int) -> int:
        return index * self.total + lane
