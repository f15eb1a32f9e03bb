"""A fault in a stream that is not over: one arrival after the other."""

from __future__ import annotations

from netpos.evaluation.faults.stream import Arrival, Hit, Order, Stream
from netpos.evaluation.faults.table import FAULTS, Fault
from netpos.messages.values import RsuInfo


def possible_live() -> dict[str, Fault]:
    """The faults that need no hand on the tracker itself: a process is killed, and ``/clock`` set
    back, by other means."""
    orders = (FAULTS["clock_back"], FAULTS["tracker_crash"])
    return {name: fault for name, fault in FAULTS.items() if fault not in orders}


class Piecewise:
    """Gives the same arrivals as the fault does with the whole stream."""

    def __init__(self, fault: Fault, hit: Hit) -> None:
        self._fault, self._hit = fault, hit

    def own(self) -> Stream:
        """What the fault sends by itself, whatever arrives: false descriptions of RSUs."""
        return self._fault.apply([], self._hit)

    def of(self, arrival: Arrival) -> Stream:
        """What becomes of an arrival."""
        return [
            found
            for found in self._fault.apply([arrival], self._hit)
            if (found.what is arrival.what and found.at_ns == arrival.at_ns)
            or not isinstance(found.what, RsuInfo | Order)
        ]
