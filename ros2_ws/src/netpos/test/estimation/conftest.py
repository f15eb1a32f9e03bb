"""Rows and random covariances as fixtures."""

from __future__ import annotations

from collections.abc import Callable

import filter_rows
import pytest
from netpos.messages.values import Array


@pytest.fixture
def row() -> Callable[..., Array]:
    return filter_rows.row


@pytest.fixture
def random_cov() -> Callable[..., Array]:
    return filter_rows.make_cov
