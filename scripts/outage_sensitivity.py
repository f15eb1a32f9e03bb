"""How much the outages of the real drive depend on the settings: ``python
scripts/outage_sensitivity.py``. Median horizontal error after 10 s (and 30 s) without RTK, one
setting at a time against those that are used."""

from __future__ import annotations

import sys
from collections.abc import Iterator

import numpy as np
from netpos.estimation.spatial.error_state import Sensors
from netpos.reproduction.deng2022 import car_drive

CONSTRAINTS_MPS = (0.1, 0.2, 0.4)
FACTORS = (0.5, 1.0, 2.0)


def _settings(used: Sensors) -> Iterator[tuple[str, Sensors]]:
    noise = used.noise
    for names, what in (
        (("accel_density_mps2_sqrthz", "gyro_density_radps_sqrthz"), "noise densities"),
        (("accel_bias_sd_mps2", "gyro_bias_sd_radps"), "biases"),
    ):
        for factor in FACTORS:
            scaled = {name: factor * getattr(noise, name) for name in names}
            yield f"{what} x {factor:g}", used._replace(noise=noise._replace(**scaled))
    for sd in CONSTRAINTS_MPS:
        constraints = used.constraints._replace(sideways_sd_mps=sd, upwards_sd_mps=sd)
        yield f"constraints {sd:g} m/s", used._replace(constraints=constraints)
    free = used.constraints._replace(standstill_sd_mps=0.0)
    yield "no standstill", used._replace(constraints=free)


def main() -> int:
    """Print one line per setting; 1 where the recording is absent."""
    known = car_drive.recording()
    if known is None:
        sys.stderr.write(f"no recording {car_drive.RECORDING}: set NETPOS_DATA\n")
        return 1
    for name, sensors in _settings(known.sensors):
        outages = car_drive.outages_with(sensors, known.start)
        ten, thirty = (float(np.median(outages.at(seconds))) for seconds in (10.0, 30.0))
        sys.stdout.write(f"{name:24s} {ten:6.2f} m after 10 s {thirty:7.2f} m after 30 s\n")
    return 0


if __name__ == "__main__":
    sys.exit(main())
