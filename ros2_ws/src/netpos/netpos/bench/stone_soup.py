"""The extended Kalman filter of Stone Soup on the same problem, where it is installed."""

from __future__ import annotations

from importlib import import_module
from typing import Any

import numpy as np

from netpos.bench.common import LeftOut, Result, faster, side_by_side
from netpos.bench.filters import called_ekf, epoch_terms
from netpos.bench.problem import HEIGHT_M, ROWS, Problem, model, problem
from netpos.estimation.measurement import VALUE, linearise
from netpos.messages.values import Array

_NAME = "EKF predict + update, 6 states, 2 RSUs, called from Python, against Stone Soup"


def _measurement_model(part: Any, rows: Array, R: Array) -> Any:
    """Model of one epoch's rows with our compiled h and H."""
    state_vector = part("types.array").StateVector
    base: Any = part("models.measurement.nonlinear").NonLinearGaussianMeasurement

    class Rows(base):  # type: ignore[misc]
        @property
        def ndim_meas(self) -> int:
            return ROWS

        def function(self, state: Any, noise: Any = False, **_: Any) -> Any:
            x = np.asarray(state.state_vector, dtype=float).reshape(-1)
            return state_vector(rows[:, VALUE] - linearise(rows, x, HEIGHT_M)[0])

        def jacobian(self, state: Any, **_: Any) -> Array:
            x = np.asarray(state.state_vector, dtype=float).reshape(-1)
            return np.asarray(linearise(rows, x, HEIGHT_M)[1])

    return Rows(ndim_state=6, mapping=tuple(range(6)), noise_covar=R)


class StoneSoupEkf:
    """Its predictor and updater; models and detections are made beforehand: only the filter's own
    cost counts. Raises ``ImportError`` where Stone Soup is not installed."""

    def __init__(self, p: Problem) -> None:
        def part(name: str) -> Any:
            return import_module(f"stonesoup.{name}")

        self._problem, self._part = p, part
        F, Q = model()
        linear = part("models.transition.linear").LinearGaussianTimeInvariantTransitionModel(
            transition_matrix=F, covariance_matrix=Q
        )
        self._predictor = part("predictor.kalman").ExtendedKalmanPredictor(linear)
        self._updater = part("updater.kalman").ExtendedKalmanUpdater(measurement_model=None)
        self._detections = [
            part("types.detection").Detection(
                part("types.array").StateVector(values),
                measurement_model=_measurement_model(part, rows, R),
            )
            for rows, (values, R) in zip(p.rows, epoch_terms(p), strict=True)
        ]

    def run(self) -> tuple[Array, Array]:
        """Posterior after all epochs."""
        hypothesis = self._part("types.hypothesis").SingleHypothesis
        state = self._part("types.state").GaussianState(self._problem.mean, self._problem.cov)
        for detection in self._detections:
            prediction = self._predictor.predict(state)
            state = self._updater.update(hypothesis(prediction, detection))
        mean = np.asarray(state.state_vector, dtype=float).reshape(-1)
        return mean, np.asarray(state.covar, dtype=float)


def stone_soup_rows(quick: bool) -> list[Result]:
    """Our filter called from Python against Stone Soup's, both on the same posterior."""
    p = problem(5 if quick else 20)
    try:
        theirs = StoneSoupEkf(p)
    except ImportError:
        return [LeftOut(_NAME, "Stone Soup is not installed; pip install stonesoup adds the row.")]
    for ours, other in zip(called_ekf(p), theirs.run(), strict=True):
        if not np.allclose(ours, other, rtol=0.0, atol=1e-6):
            return [LeftOut(_NAME, "Stone Soup's posterior is not ours: nothing to compare.")]
    long = problem(20 * p.epochs)
    cost = side_by_side(
        {"ours": (lambda: called_ekf(long), long.epochs), "theirs": (theirs.run, p.epochs)},
        2 if quick else 50,
    )
    return [faster(_NAME, cost["ours"], "Stone Soup EKF", cost["theirs"], 20.0)]
