"""RSUs that answer a beacon together: all of them, or those of one of several networks, each at
its own times, with its own errors, under its own names (dvornikov2017: primary processing)."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from netpos.messages.values import Beacon, RsuInfo
from netpos.radio.measure import Sites
from netpos.radio.noise import generator, normals, stream_key
from netpos.scenario.measured import FixedErrors
from netpos.scenario.schema import Network, Scenario

Array = npt.NDArray[np.float64]


@dataclass(frozen=True, slots=True, kw_only=True)
class Answering:
    """``rsus``: indices of the RSUs; ``names``: what they call each device; ``position_sd_m``: of
    the fixes they compute, per axis; ``network``: None for all RSUs at all times."""

    rsus: npt.NDArray[np.int64]
    names: Mapping[str, str]
    position_sd_m: float
    network: Network | None = None

    def answers(self, elapsed_ns: int) -> bool:
        """Whether a beacon so long after the start of the run is answered."""
        if self.network is None:
            return True
        since_ns = elapsed_ns - self.network.phase_ns
        return since_ns >= 0 and since_ns % self.network.interval_ns == 0

    def sites(self, sites: Sites) -> Sites:
        """The sites of these RSUs among those of all."""
        if self.network is None:
            return sites
        return sites._replace(**{name: part[self.rsus] for name, part in sites._asdict().items()})

    def fix(self, beacon: Beacon, rsu_id: str, seed: int) -> tuple[Array, Array]:
        """Position (3,) m and covariance (3, 3) of a fix."""
        error = fix_errors([beacon.stamp_ns], self.position_sd_m, seed, rsu_id, beacon.vue_id)
        position: Array = np.asarray(beacon.position) + error[0]
        return position, self.position_sd_m**2 * np.eye(3)


def fix_errors(
    stamps_ns: npt.ArrayLike, sd_m: float, seed: int, rsu_id: str, vue_id: str
) -> Array:
    """(n, 3) errors [m] of the fixes of a device by one RSU at stamps (n,)."""
    return sd_m * normals(stamps_ns, 3, stream_key(seed, f"{rsu_id}/{vue_id}/fix"))


def answering_of(scenario: Scenario, rsus: tuple[RsuInfo, ...]) -> tuple[Answering, ...]:
    """The RSUs that answer, for each network."""
    errors = scenario.measurement.errors
    sd = errors.position_sd_m or 0.0 if isinstance(errors, FixedErrors) else 0.0
    if not scenario.networks:
        same = {vue: vue for vue in scenario.vue_ids}
        return (Answering(rsus=np.arange(len(rsus)), names=same, position_sd_m=sd),)
    return tuple(
        Answering(
            rsus=np.array([i for i, rsu in enumerate(rsus) if rsu.network == network.name]),
            names=names_of(scenario, network),
            position_sd_m=network.position_sd_m or sd,
            network=network,
        )
        for network in scenario.networks
    )


def names_of(scenario: Scenario, network: Network) -> dict[str, str]:
    """Name that a network gives each device, by its name in the scenario."""
    vues = scenario.vue_ids
    if not network.own_names:
        return {vue: vue for vue in vues}
    order = generator(scenario.seed, f"{network.name}/names").permutation(len(vues))
    return {
        vue: f"{network.name}_{number + 1}"
        for vue, number in zip(vues, order.tolist(), strict=True)
    }
