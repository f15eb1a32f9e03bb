"""The calibration varies what it says, on seeds of its own."""

from __future__ import annotations

import numpy as np
import pytest
from netpos.evaluation.work import Work
from netpos.radio.waveform import received_snr
from netpos.reproduction.fokin2020.metis_calibration import (
    CANDIDATES,
    FIRST_SEED,
    Candidate,
    table,
)
from netpos.reproduction.fokin2020.paper import METIS
from netpos.reproduction.frame import DEFAULT_RUNS
from netpos.scenario import load_scenario
from netpos.scenario.build import errors_of

CHOSEN = Candidate(stride=3, columns=4, spacing_wavelengths=0.35)


@pytest.mark.parametrize(
    ("scenario", "candidate"),
    [("metis_madrid", CHOSEN), ("metis_madrid_strong_signal", Candidate())],
)
def test_the_scenarios_are_candidates(scenario: str, candidate: Candidate) -> None:
    experiment = candidate.of(METIS[0][0], "paper")
    tried = load_scenario(experiment.scenario, changes=dict(experiment.changes))
    ours, other = errors_of(load_scenario(scenario)), errors_of(tried)
    np.testing.assert_allclose(ours.second_moment, other.second_moment, rtol=1e-12)
    assert ours.snr_at_0_db_loss == pytest.approx(other.snr_at_0_db_loss)
    assert ours.rms_bandwidth_hz == other.rms_bandwidth_hz
    assert candidate in CANDIDATES


@pytest.mark.parametrize("scenario", ["metis_madrid", "metis_madrid_strong_signal"])
def test_the_snr_at_the_cap_is_what_the_scenario_says(scenario: str) -> None:
    errors = load_scenario(scenario).measurement.errors
    snr = received_snr(errors.waveform, errors.path_loss, errors.array.count, 150.0)
    assert 10.0 * np.log10(snr) == pytest.approx(13.0, abs=0.5)


def test_no_scored_seed_calibrates() -> None:
    assert FIRST_SEED > 10 * DEFAULT_RUNS


def test_a_line_per_candidate() -> None:
    with Work(1, FIRST_SEED, 1) as work:
        head, rule, paper, *lines = table(work, (CHOSEN,))
    assert len(lines) == 1
    assert {line.count("|") for line in (head, rule, paper, *lines)} == {8}
    assert "0.4 m, 4 ns" in paper
    assert lines[0].startswith("| stride 3, 4 columns, 0.35 wavelengths, -40 dBm |")
