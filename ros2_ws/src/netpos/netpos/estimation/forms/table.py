"""The filter forms: one line each. Everything that depends on the form is derived from this
table."""

from __future__ import annotations

from typing import Any

from netpos.estimation.forms import ekf, kf, srukf, ukf
from netpos.estimation.forms.form import FilterForm

# The place in the table is the number of the form.
FORMS: tuple[FilterForm, ...] = (
    ekf.EKF,
    ekf.IEKF,
    ukf.FORM,
    srukf.FORM,
    kf.FORM,
)
DEFAULT = ekf.IEKF.name
"""The form of a tracker that is told nothing."""


def words() -> dict[str, str]:
    """The names of the forms, and what each means."""
    return {form.name: form.summary for form in FORMS}


def form_of(word: str) -> FilterForm:
    """The form of one of ``words``; raises ``KeyError`` for another word."""
    return {form.name: form for form in FORMS}[word]


def number_of(form: FilterForm) -> int:
    """Its place in the table."""
    return FORMS.index(form)


def parameters() -> dict[str, Any]:
    """Tracker parameters that the forms declare: name and field."""
    return {name: entry for form in FORMS for name, entry in form.parameters.items()}


def _check() -> None:
    if len(words()) < len(FORMS):
        names = [form.name for form in FORMS]
        raise ValueError(f"two filter forms share a name; give each its own, got {names}")


_check()
