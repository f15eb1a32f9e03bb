"""Pictures: what is drawn follows from the numbers."""

from __future__ import annotations

import numpy as np
import pytest
from netpos.evaluation.pictures import magnification


@pytest.mark.parametrize(
    ("length_m", "expected"),
    [(10.0, 1), (2.0, 1), (1.9, 2), (0.21, 10), (0.19, 20), (1e-9, 5000), (0.0, 1)],
)
def test_ellipses_are_enlarged_until_they_show_on_a_map_of_100_m(
    length_m: float, expected: int
) -> None:
    assert magnification(np.full(3, length_m), 100.0) == expected
