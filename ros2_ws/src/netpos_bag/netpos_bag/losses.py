"""Messages that were published and never arrived, by the numbers their publishers give them."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field


@dataclass(slots=True)
class Losses:
    """Of one topic. The middleware numbers the messages of each publisher from 1 on, and does not
    say which publisher a message is of: the one whose number it follows.

    ``publishers`` tells how many the topic has now. What one sent before it was first heard is no
    loss; nor is a gap that is heard while another publisher has not been heard yet.
    """

    publishers: Callable[[], int]
    count: int = 0
    _last: list[int] = field(default_factory=list)  # number last heard, by publisher

    def arrived(self, number: int | None) -> int:
        """Take the number of a message that arrived; how many are found missing before it.

        A middleware that gives no numbers (None) tells of no loss.
        """
        if number is None:
            return 0
        if number - 1 in self._last:
            self._last[self._last.index(number - 1)] = number
            return 0
        before = [last for last in self._last if last < number]
        if not before or len(self._last) < self.publishers():
            self._last.append(number)
            return 0
        nearest = max(before)
        self._last[self._last.index(nearest)] = number
        missing = number - 1 - nearest
        self.count += missing
        return missing
