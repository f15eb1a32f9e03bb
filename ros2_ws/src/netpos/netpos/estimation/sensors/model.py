"""What one sensor is: the record that every module of this folder fills in."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from enum import IntEnum

from netpos.estimation.dispatch import Kernel
from netpos.messages.values import AngleConvention, Field


class Wraps(IntEnum):
    """What of a quantity is known modulo a whole turn."""

    NEVER = 0
    INNOVATION = 1
    """Measured minus predicted value; predictions themselves are continuous."""
    ALWAYS = 2
    """Every difference, of two predictions too: an angle."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Refusal:
    """A value that is refused: the reason that is counted, the test, and what to do about it."""

    reason: str
    is_bad: Callable[[float], bool]
    remedy: str


@dataclass(frozen=True, slots=True, kw_only=True)
class Reading:
    """How a measurement message carries a quantity, and how a row takes it over."""

    quantity: str
    """Name in scenarios; two sensors share it where only the angle convention differs."""
    field: Field
    value: str
    """Attribute of ``RsuMeasurement`` that holds the value."""
    variance: str
    """Attribute that holds its variance."""
    unit: str
    convention: AngleConvention | None = None
    """RSUs with this angle convention only; None: every RSU."""
    scale: float = 1.0
    """From the unit of the message to metres or radians."""
    to_row: Kernel | None = None
    """(value, variance) of the message, after ``scale``, to those of the row; None: the same."""
    from_master: bool = False
    """The RSU's position in the row is that of its master antenna."""
    along_array: bool = False
    """The first axis in the row is that of the two antennas, in radians (``rows.rsu_place``)."""
    refusals: tuple[Refusal, ...] = ()
    simulated: str | None = None
    """What of ``radio.measure.QUANTITIES`` the simulator sends as its value and variance; None: no
    simulator sends it."""


def angle_reading(
    quantity: str,
    *,
    convention: AngleConvention,
    to_row: Kernel | None = None,
    simulated: str | None = None,
) -> Reading:
    """The ``Reading`` of an ``azimuth`` or ``elevation`` [rad]."""
    return Reading(
        quantity=quantity,
        field=Field[quantity.upper()],
        value=f"{quantity}_rad",
        variance=f"{quantity}_var",
        unit="rad",
        convention=convention,
        to_row=to_row,
        simulated=simulated,
    )


@dataclass(frozen=True, slots=True, kw_only=True)
class Sensor:
    """One kind of measurement row.

    A sensor has one or two models; a model gives the value h and its gradient H.

    of_offset : ``(row, dx, dy, dz) -> (h, hx, hy, hz)``, d = antenna - RSU in map [m]. Planar and
        spatial filters use the same function.
    of_state : ``(row, mean, h) -> h``, which adds the gradient to ``h`` (n,); planar filters only
    of_antenna : ``(row, x, y, z) -> (h, hx, hy, hz)`` of the antenna in map; spatial filters only
    of_navigation : ``(row, nav, C, h) -> h``, which adds the gradient to ``h`` (n,); spatial only

    second_order : variance of what linearising leaves out, or a bound of it, as an update takes
        it: ``(row, dx, dy, dz, cov, axes)`` beside ``of_offset``, ``(row, mean, cov)`` beside
        ``of_state``. ``axes`` is 2 or 3, the size of the position in ``cov``. None: 0.
    second_order_mean : ``(row, dx, dy, dz, cov, axes)``, beside ``of_offset``: how far the mean
        value is above that of the mean. None: 0
    is_bound : ``second_order`` is the term with the largest curvature in every direction
    exact_second_order : ``(row, dx, dy, dz, cov, axes)`` of the true curvature, where
        ``second_order`` is a bound and weights of priors need better
    """

    name: str
    """In upper case: name of the row kind, in diagnostics and bias states."""
    kind: int
    """Number in the KIND column, 0 to 62; recordings do not hold it."""
    of_offset: Kernel | None = None
    of_state: Kernel | None = None
    of_antenna: Kernel | None = None
    of_navigation: Kernel | None = None
    second_order: Kernel | None = None
    second_order_mean: Kernel | None = None
    is_bound: bool = False
    exact_second_order: Kernel | None = None
    wraps: Wraps = Wraps.NEVER
    has_clock: bool = False
    """The device's clock offset is added to the value."""
    adds_biases: bool = True
    """The states BIAS and COMMON of the row are added to the value, and REFERENCE is subtracted;
    False: the model uses them."""
    difference_of: int = -1
    """Kind of the quantity that it compares between the RSU and a second one,
    ``reference_rsu_id``; where that is from the first is in the first three of AXES. -1: it
    compares none."""
    is_range: bool = False
    """A distance, so that a blocked path makes it late and one epoch leaves a ring."""
    stretches: bool = False
    """A distance that a network may measure too long by the same share everywhere."""
    in_strapdown: bool = False
    """A strapdown track takes it."""
    is_reported: bool = True
    """Its innovations are part of the health of an RSU."""
    bias_sd: str | None = None
    """Attribute of ``RsuInfo``: sd of the RSU's own bias in it."""
    common_bias_sd: str | None = None
    """Attribute of ``RsuInfo``: sd of the bias its network shares."""
    reading: Reading | None = None
    """None: no field of ``RsuMeasurement`` gives rows of this kind by itself."""
