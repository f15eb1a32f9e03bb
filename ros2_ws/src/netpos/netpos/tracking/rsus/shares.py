"""How often the path of each RSU to one device is blocked, and how often its values are outliers,
learned from its measurements."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace

from netpos.estimation.measurement import BLOCKED, GROUP, KIND, OUTLIER_SHARE
from netpos.estimation.mixture.outliers import OUTLIERS
from netpos.estimation.sensors.table import SENSORS
from netpos.estimation.update.robust import update_prior
from netpos.messages.values import RsuMeasurement
from netpos.tracking.config import TrackerConfig
from netpos.tracking.estimators.epoch_rows import EpochRows

_LATE = {sensor.kind for sensor in SENSORS if sensor.is_range}
_BLOCKED_STRENGTH = 10.0  # measurements the configured share counts for
# A turn that nobody has noticed yet is refused, too: some in a row say little of the RSU.
_OUTLIER_STRENGTH, _OUTLIER_MEMORY = 100.0, 300.0


@dataclass(slots=True)
class Share:
    """Beta distribution (alpha, beta) of a share of the measurements of each RSU: ``expected``
    where nothing was heard yet, which counts for ``strength`` measurements; ``memory``: of how
    many it is learned. Where 0 is expected nothing is learned."""

    expected: float
    strength: float
    memory: float
    _of: dict[str, tuple[float, float]] = field(default_factory=dict)

    @property
    def is_learned(self) -> bool:
        """Whether one is expected."""
        return self.expected > 0.0

    def mean(self, rsu_id: str) -> float:
        """Its mean, of an RSU."""
        alpha, beta = self._of.get(rsu_id, self._prior)
        return alpha / (alpha + beta)

    def hear(self, rsu_id: str, probability: float) -> None:
        """Take a measurement that counts with a ``probability``."""
        known = self._of.get(rsu_id, self._prior)
        keep = 1.0 - 1.0 / self.memory
        self._of[rsu_id] = update_prior(*known, probability, keep, *self._prior)

    def copy(self) -> Share:
        """An independent copy."""
        return replace(self, _of=self._of.copy())

    @property
    def _prior(self) -> tuple[float, float]:
        return self.strength * self.expected, self.strength * (1.0 - self.expected)


@dataclass(frozen=True, slots=True)
class Shares:
    """What is known of the RSUs by one device: shares of blocked paths, if any are expected, and
    of outliers, if errors are learned."""

    blocked: Share
    outliers: Share

    @classmethod
    def unknown(cls, config: TrackerConfig) -> Shares:
        """With nothing learned."""
        outliers = OUTLIERS if config.learn_errors else 0.0
        return cls(
            Share(config.nlos_probability, _BLOCKED_STRENGTH, config.nlos_memory),
            Share(outliers, _OUTLIER_STRENGTH, _OUTLIER_MEMORY),
        )

    def copy(self) -> Shares:
        """An independent copy."""
        return Shares(self.blocked.copy(), self.outliers.copy())

    @property
    def _are_learned(self) -> bool:
        return self.blocked.is_learned or self.outliers.is_learned

    def expect(self, epoch_rows: EpochRows) -> None:
        """Write each RSU's shares into its rows, for the filter to start from."""
        if not self._are_learned:
            return
        for i, _, rsu_id in _measured(epoch_rows):
            row = epoch_rows.rows[i]
            if self.blocked.is_learned and int(row[KIND]) in _LATE:
                row[BLOCKED] = self.blocked.mean(rsu_id)
            if self.outliers.is_learned:
                row[OUTLIER_SHARE] = self.outliers.mean(rsu_id)

    def learn(self, epoch_rows: EpochRows, outliers: Sequence[float]) -> None:
        """Take over what the filter made of the rows, and with which probability each group is one
        of the ``outliers``."""
        if not self._are_learned:
            return
        heard = None
        for i, group, rsu_id in _measured(epoch_rows):
            row = epoch_rows.rows[i]
            if self.blocked.is_learned and int(row[KIND]) in _LATE:
                self.blocked.hear(rsu_id, float(row[BLOCKED]))
            if self.outliers.is_learned and group != heard:
                self.outliers.hear(rsu_id, outliers[group])
            heard = group


def _measured(epoch_rows: EpochRows) -> Iterator[tuple[int, int, str]]:
    """Each row that an RSU measured, its group and the RSU."""
    for i, group in enumerate(epoch_rows.rows[:, GROUP].astype(int).tolist()):
        source = epoch_rows.items[group]
        if isinstance(source, RsuMeasurement):
            yield i, group, source.rsu_id
