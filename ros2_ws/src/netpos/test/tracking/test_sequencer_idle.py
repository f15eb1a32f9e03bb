"""A sequencer that says there is nothing to release releases nothing."""

from __future__ import annotations

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st
from netpos.messages.values import InitialPose, RsuMeasurement, Velocity
from netpos.tracking.ordering.sequencer import IMU, Sequencer

MS = 1_000_000


def rsu(stamp_ms: int, rsu_id: str, expected: int) -> RsuMeasurement:
    return RsuMeasurement(stamp_ns=stamp_ms * MS, rsu_id=rsu_id, vue_id="v", expected=expected)


def walked(stamp_ms: int) -> Velocity:
    return Velocity(stamp_ns=stamp_ms * MS, vue_id="v", velocity=np.zeros(2), cov=np.eye(2))


def pose(stamp_ms: int) -> InitialPose:
    return InitialPose(stamp_ns=stamp_ms * MS, vue_id="v", position=np.zeros(3), cov=np.eye(3))


@settings(max_examples=200, deadline=None)
@given(
    st.lists(st.tuples(st.integers(1, 9), st.sampled_from("abcvp")), max_size=25), st.booleans()
)
def test_while_idle_there_is_nothing_to_release(
    arrivals: list[tuple[int, str]], history: bool
) -> None:
    sequencer = Sequencer(200 * MS, history_ns=400 * MS if history else 0)
    for tenth, kind in arrivals:
        stamp = 100 * tenth
        item = {"v": walked(stamp), "p": pose(stamp)}.get(kind) or rsu(stamp, kind, expected=3)
        sequencer.add(item)
        if sequencer.idle:
            assert sequencer.take_late() == []
            assert sequencer.release() == []


def test_idle_ends_with_whatever_else_is_heard() -> None:
    sequencer = Sequencer(200 * MS)
    sequencer.add(rsu(100, "a", expected=2))
    assert sequencer.idle
    sequencer.mark(IMU, 400 * MS)
    assert not sequencer.idle
    assert [epoch.stamp_ns for epoch in sequencer.release()] == [100 * MS]
    assert not Sequencer(0).idle
    at_once = Sequencer(0)
    at_once.add(rsu(100, "a", expected=2))
    assert not at_once.idle
    assert [epoch.stamp_ns for epoch in at_once.release()] == [100 * MS]
