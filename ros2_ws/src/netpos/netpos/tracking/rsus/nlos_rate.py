"""How often the path of each RSU to one device is blocked, learned from its ranges and times."""

from __future__ import annotations

from dataclasses import dataclass, field

from netpos.estimation.measurement import BLOCKED, GROUP, KIND
from netpos.estimation.sensors.table import SENSORS
from netpos.estimation.update.robust import update_prior
from netpos.messages.values import RsuMeasurement
from netpos.tracking.config import TrackerConfig
from netpos.tracking.estimators.epoch_rows import EpochRows

_LATE = {sensor.kind for sensor in SENSORS if sensor.is_range}
_STRENGTH = 10.0  # measurements the configured share counts for


@dataclass(slots=True)
class NlosRate:
    """Beta distribution (alpha, beta) of the share of blocked paths per RSU, that of the
    configuration where nothing was heard yet."""

    probability: float
    memory: float
    _shares: dict[str, tuple[float, float]] = field(default_factory=dict)

    @classmethod
    def of(cls, config: TrackerConfig) -> NlosRate:
        """With nothing learned."""
        return cls(config.nlos_probability, config.nlos_memory)

    def copy(self) -> NlosRate:
        """An independent copy."""
        return NlosRate(self.probability, self.memory, self._shares.copy())

    def share(self, rsu_id: str) -> float:
        """Mean share of blocked paths."""
        alpha, beta = self._share(rsu_id)
        return alpha / (alpha + beta)

    def expect(self, epoch_rows: EpochRows) -> None:
        """Write each RSU's share into its rows, for the filter to start from."""
        for row, rsu_id in self._late(epoch_rows):
            epoch_rows.rows[row, BLOCKED] = self.share(rsu_id)

    def learn(self, epoch_rows: EpochRows) -> None:
        """Take over what the filter made of the rows."""
        for row, rsu_id in self._late(epoch_rows):
            self._shares[rsu_id] = update_prior(
                *self._share(rsu_id),
                epoch_rows.rows[row, BLOCKED],
                1.0 - 1.0 / self.memory,
                *self._prior,
            )

    @property
    def _prior(self) -> tuple[float, float]:
        return _STRENGTH * self.probability, _STRENGTH * (1.0 - self.probability)

    def _share(self, rsu_id: str) -> tuple[float, float]:
        return self._shares.get(rsu_id, self._prior)

    def _late(self, epoch_rows: EpochRows) -> list[tuple[int, str]]:
        """Rows that a blocked path makes late, and their RSUs; none where the option is off."""
        if self.probability == 0.0:
            return []
        sources = [epoch_rows.items[int(group)] for group in epoch_rows.rows[:, GROUP]]
        return [
            (i, source.rsu_id)
            for i, source in enumerate(sources)
            if isinstance(source, RsuMeasurement) and int(epoch_rows.rows[i, KIND]) in _LATE
        ]
