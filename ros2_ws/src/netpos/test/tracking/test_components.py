"""The mixture of a track is what it publishes: the same moments, the same modes."""

from __future__ import annotations

import numpy as np
import pytest
from anchor_walk import CONFIG, INFO, Walk
from netpos.messages.values import TrackState
from netpos.tracking import Tracker, TrackerConfig


def test_the_components_of_a_track_have_the_published_moments_and_modes() -> None:
    walk = Walk(np.array([-1.0, 4.0]), 0.4, 3.0, seed=5)
    tracker = Tracker(TrackerConfig(**CONFIG))
    tracker.add_rsu(INFO)
    states = set()
    for k in range(len(walk.position)):
        for item in walk.items(k):
            assert tracker.add(item) is None
        for output in (*tracker.process(), *tracker.flush()):
            found = tracker.track(output.status.vue_id).components
            if output.odometry is None:
                assert found is None
                continue
            assert found is not None
            states.add(output.status.state)
            weights = np.exp(found.log_weights)
            mean = weights @ found.means
            away = found.means - mean
            cov = np.einsum("k,kab->ab", weights, found.covs) + away.T @ (weights[:, None] * away)
            assert weights.sum() == pytest.approx(1.0)
            np.testing.assert_allclose(output.odometry.position[:2], mean[:2], atol=1e-9)
            np.testing.assert_allclose(output.odometry.pose_cov[:2, :2], cov[:2, :2], rtol=1e-6)
            assert len(output.status.modes) <= weights.size
    assert {TrackState.AMBIGUOUS, TrackState.TRACKING} <= states
