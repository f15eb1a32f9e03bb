"""What the fusion of tracks refuses at the door, and why."""

from __future__ import annotations

import numpy as np

from netpos.messages.fields import MAP_FRAME, stamp_fault
from netpos.messages.topics import is_vue_id
from netpos.messages.values import NetworkTrack

_LARGEST = 1e9
# Variances (m, m/s, m/s^2) beyond which double precision cannot fuse with metres.
_VAR_MIN, _VAR_MAX = 1e-12, 1e12
_CONDITION_MIN = 1e-13  # smallest over largest eigenvalue of the correlations
_ASYMMETRY_MAX = 1e-6
_OWN_EXCESS_MAX = 1e-6  # of own noise over the whole, relative to the whole


def network_track_fault(track: NetworkTrack, map_frame: str = MAP_FRAME) -> str | None:
    """Reason to refuse a network's track whatever the other networks say, or None."""
    if not (is_vue_id(track.network) and is_vue_id(track.vue_id)):
        return "name"
    if track.stamp_ns <= 0:
        return stamp_fault(track.stamp_ns)
    if track.frame_id != map_frame:
        return "frame"
    if track.mean.shape != (6,) or track.cov.shape != (6, 6) or track.own_cov.shape != (6, 6):
        return "shape"
    values = np.concatenate([track.mean, track.cov.ravel(), track.own_cov.ravel()])
    if not np.isfinite([*values, track.height_m]).all() or np.abs(track.mean).max() >= _LARGEST:
        return "not_finite"
    return _covariance_fault(track)


def _covariance_fault(track: NetworkTrack) -> str | None:
    variance = np.diagonal(track.cov)
    if not (variance.min() >= _VAR_MIN and variance.max() <= _VAR_MAX):
        return "covariance"
    scale = np.sqrt(np.outer(variance, variance))
    correlation, own = track.cov / scale, track.own_cov / scale
    for matrix in (correlation, own):
        if np.abs(matrix - matrix.T).max() > _ASYMMETRY_MAX:
            return "covariance"
    smallest, *_, largest = np.linalg.eigvalsh(correlation)
    if smallest <= _CONDITION_MIN * largest:
        return "covariance"
    if np.linalg.eigvalsh(own)[0] < -_OWN_EXCESS_MAX:
        return "own_covariance"
    return (
        "own_covariance" if np.linalg.eigvalsh(correlation - own)[0] < -_OWN_EXCESS_MAX else None
    )
