"""Time of arrival: |d| and the device's clock offset, both times the speed of light
(fokin2020:eq.41)."""

from __future__ import annotations

from netpos.estimation.motion import SPEED_OF_LIGHT_MPS
from netpos.estimation.sensors.model import Reading, Sensor
from netpos.estimation.sensors.range import bend, distance, exact
from netpos.messages.values import Field

SENSOR = Sensor(
    name="TOA",
    kind=2,
    of_offset=distance,
    second_order=exact,
    second_order_mean=bend,
    has_clock=True,
    is_range=True,
    in_strapdown=True,
    bias_sd="range_bias_sd_m",
    common_bias_sd="common_range_bias_sd_m",
    reading=Reading(
        quantity="toa",
        field=Field.TOA,
        value="toa_s",
        variance="toa_var",
        unit="s",
        scale=SPEED_OF_LIGHT_MPS,
        from_master=True,
        simulated="toa",
    ),
)
