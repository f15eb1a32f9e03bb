"""The benchmark's arithmetic; never how fast something is."""

from __future__ import annotations

import pytest
from netpos.evaluation.bench import as_json, ekf_against_filterpy


def test_a_ratio_is_reference_over_ours() -> None:
    row = ekf_against_filterpy()
    assert row.ours_s > 0.0
    assert row.ratio == pytest.approx(row.reference_s / row.ours_s)
    assert as_json([row])["rows"][0] == {
        "name": row.name,
        "ours_s": row.ours_s,
        "reference": row.reference,
        "reference_s": row.reference_s,
        "ratio": row.ratio,
    }
