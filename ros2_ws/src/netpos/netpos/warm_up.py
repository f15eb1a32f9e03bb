"""Compile every kernel into the cache on disk: ``python -m netpos.warm_up``, the last act of set-
up."""

from __future__ import annotations

from netpos.tracking.warm_up import warm_up as warm_up_tracking


def main() -> None:
    """Compile the kernels of the tracker and of the simulator."""
    warm_up_tracking()
    from netpos.scenario import Simulation, load_scenario  # noqa: PLC0415 - after the tracker's

    Simulation(load_scenario("fast_pass")).warm_up()


if __name__ == "__main__":
    main()
