"""Streaming step detection from specific force: sample by sample, bounded delay.

1. Each sample is averaged into cells of 20 ms, so 50-285 Hz streams give the same signal.
2. The signal is one of two:
   ``bounce``  the vertical component, the projection on gravity low-passed with 1 s. It does not
      depend on how the device is turned (pocket, bag, hand, armband). The smooth peak after each
      initial contact is the step (Zijlstra and Hof, Gait & Posture 18(2), 2003; Gaussian
      smoothing as in McCamley et al., Gait & Posture 36(2), 2012).
   ``impact``  the norm of the jerk. At the lower back every foot contact shows as a short burst
      on all axes, even where a slow, unsteady gait hardly bounces.
3. A zero-phase Gaussian smooths the impacts; a zero-phase difference of two, from 0.6 to 3 Hz,
   passes the bounce.
4. A peak counts when its prominence exceeds a floor and a fraction of the running prominence. An
   impact must also be sharp: its frequency, from the ratio of the second to the first
   difference, 2 sin(pi f cell), is above ``min_impact_hz``; setting off and bending are slower.
5. A device being turned in the hand is not walking: peaks with a fast tilt are refused.
6. ``bout_steps`` peaks in a row start a bout; the first ones are then released together.

Stillness is the moving-variance detector (Skog et al., IEEE Trans. Biomed. Eng. 57(11), 2010).
"""

from __future__ import annotations

import math
from collections import deque
from dataclasses import dataclass
from typing import Literal

import numpy as np
import numpy.typing as npt

from netpos.common.parameters import check_fields, choice, count, positive, real

Array = npt.NDArray[np.float64]
Vector = tuple[float, float, float]

CELL_NS = 20_000_000
CELL_S = CELL_NS * 1e-9
LONGEST_STEP = 1.5  # typical periods; what is longer began with standing
_SLOWEST_HZ, _FASTEST_HZ = 0.8, 2.5  # cadences whose attenuation is made good


@dataclass(frozen=True, slots=True, kw_only=True)
class StepConfig:
    """Parameters of ``StepDetector``; a bad value raises ``ValueError`` here.

    The defaults are for a device carried anyhow; ``waist()`` for one worn at the lower back.
    ``min_prominence`` is in m/s^2 of ``bounce`` and in m/s^3 of ``impact``, which has no trend.
    """

    signal: Literal["bounce", "impact"] = choice(
        "bounce", ("bounce", "impact"), "bounce (of the body) | impact (of the foot)"
    )
    smooth_sd_s: float = positive(0.08, "sd of the Gaussian that smooths the signal")
    trend_sd_s: float = positive(0.4, "bounce: sd of the Gaussian taken off as trend")
    filter_half_width_s: float = positive(0.5, "half width of both")
    peak_half_width_s: float = positive(0.1, "a peak is the largest value within this")
    min_prominence: float = positive(0.3, "smallest prominence of a step's peak")
    prominence_fraction: float = positive(0.4, "the same as a share of the running prominence")
    prominence_memory_s: float = positive(4.0, "decay of the running prominence")
    min_height_fraction: float = positive(0.1, "smallest height over prominence of a peak")
    min_impact_hz: float = positive(5.0, "impact: lowest frequency of a foot contact")
    min_interval_s: float = positive(0.3, "shortest time between two steps")
    min_interval_fraction: float = positive(0.45, "the same as a share of the typical period")
    max_interval_s: float = positive(1.5, "longest time between two steps of a bout")
    contact_lag_s: float = real(-0.05, -0.3, 0.3, "from the peak to the foot contact")
    gravity_memory_s: float = positive(1.0, "time constant of the direction of gravity")
    max_tilt_change_rad: float = positive(0.26, "a device that tilts more is being handled")
    bout_steps: int = count(3, "peaks in a row that start a bout")
    still_window_s: float = positive(1.0, "length of the window of stillness")
    still_acceleration_sd_mps2: float = positive(0.15, "a still body shakes less")

    def __post_init__(self) -> None:
        check_fields(self, "steps.")
        if self.min_impact_hz >= 0.5 / CELL_S:
            raise ValueError(
                f"steps.min_impact_hz must be below {0.5 / CELL_S:g} Hz, got {self.min_impact_hz}"
            )
        for name in ("prominence_fraction", "min_height_fraction", "min_interval_fraction"):
            if getattr(self, name) >= 1:
                raise ValueError(f"steps.{name} must be below 1, got {getattr(self, name)}")
        if self.trend_sd_s <= self.smooth_sd_s:
            raise ValueError(
                f"steps.trend_sd_s ({self.trend_sd_s}) must exceed smooth_sd_s "
                f"({self.smooth_sd_s}): they bound the pass band"
            )
        if self.max_interval_s <= self.min_interval_s:
            raise ValueError(
                f"steps.max_interval_s ({self.max_interval_s}) must exceed min_interval_s "
                f"({self.min_interval_s})"
            )
        if self.filter_half_width_s < 2 * self.smooth_sd_s:
            raise ValueError(
                f"steps.filter_half_width_s must be >= 2 smooth_sd_s, got "
                f"{self.filter_half_width_s}"
            )

    @classmethod
    def waist(cls) -> StepConfig:
        """For a device worn at the waist, also by slow and unsteady walkers."""
        return cls(
            signal="impact",
            smooth_sd_s=0.05,
            filter_half_width_s=0.2,
            min_prominence=8.0,
            prominence_fraction=0.2,
            max_interval_s=2.5,
            contact_lag_s=-0.085,
            max_tilt_change_rad=math.pi,  # a person who bends down may well be walking
            bout_steps=2,
            still_window_s=0.4,
        )

    @property
    def delay_s(self) -> float:
        """Longest time from a peak to the sample that reveals it (steps within a bout)."""
        return self.filter_half_width_s + self.peak_half_width_s + 2 * CELL_S


@dataclass(frozen=True, slots=True)
class Step:
    """One detected step.

    start_ns, end_ns : initial contacts that bound it; ``start_ns`` is the previous step's
        ``end_ns``; at the start of a bout and after a pause, one typical period earlier
    bounce_mps2 : range of the vertical acceleration over the step, with the attenuation of the
        band-pass at the step's cadence made good
    """

    start_ns: int
    end_ns: int
    bounce_mps2: float

    @property
    def duration_s(self) -> float:
        return (self.end_ns - self.start_ns) * 1e-9

    @property
    def cadence_hz(self) -> float:
        return 1.0 / self.duration_s


def smoothing_kernel(smooth_sd_s: float, half_width_s: float) -> Array:
    """(2n+1,) symmetric Gaussian of unit area on the cell grid."""
    n = round(half_width_s / CELL_S)
    kernel: Array = np.exp(-0.5 * (np.arange(-n, n + 1) * CELL_S / smooth_sd_s) ** 2)
    kernel /= kernel.sum()
    return kernel


def band_pass_kernel(smooth_sd_s: float, trend_sd_s: float, half_width_s: float) -> Array:
    """(2n+1,) symmetric difference of two unit-area Gaussians on the cell grid; sums to 0."""
    return smoothing_kernel(smooth_sd_s, half_width_s) - smoothing_kernel(trend_sd_s, half_width_s)


def amplitude_response(kernel: Array, frequency_hz: float) -> float:
    """Gain of a symmetric kernel on the cell grid at a frequency."""
    n = kernel.size // 2
    t = np.arange(-n, n + 1) * CELL_S
    return float(kernel @ np.cos(2 * np.pi * frequency_hz * t))


class CellAverager:
    """Mean of the linear interpolant over consecutive cells: anti-aliased 50 Hz grid."""

    def __init__(self) -> None:
        self.reset()

    def reset(self) -> None:
        self._t_ns: int | None = None
        self._v: Vector = (0.0, 0.0, 0.0)
        self._edge_ns = 0
        self._area: Vector = (0.0, 0.0, 0.0)

    def add(self, stamp_ns: int, value: Vector) -> list[tuple[int, Vector]]:
        """Cells finished by this sample: (centre stamp, mean). Stamps must increase."""
        out: list[tuple[int, Vector]] = []
        if self._t_ns is None:
            self._t_ns, self._v, self._edge_ns = stamp_ns, value, stamp_ns + CELL_NS
            return out
        while stamp_ns >= self._edge_ns:
            a = (self._edge_ns - self._t_ns) / (stamp_ns - self._t_ns)
            u = self._v
            edge = tuple(u[i] + a * (value[i] - u[i]) for i in range(3))
            self._advance(self._edge_ns, (edge[0], edge[1], edge[2]))
            s = 1.0 / CELL_S
            mean = (self._area[0] * s, self._area[1] * s, self._area[2] * s)
            out.append((self._edge_ns - CELL_NS // 2, mean))
            self._area = (0.0, 0.0, 0.0)
            self._edge_ns += CELL_NS
            if stamp_ns == self._t_ns:
                return out
        self._advance(stamp_ns, value)
        return out

    def _advance(self, t_ns: int, v: Vector) -> None:
        assert self._t_ns is not None
        h = 0.5e-9 * (t_ns - self._t_ns)
        a, u = self._area, self._v
        self._area = (a[0] + h * (u[0] + v[0]), a[1] + h * (u[1] + v[1]), a[2] + h * (u[2] + v[2]))
        self._t_ns, self._v = t_ns, v


class _Mean:
    """First-order low-pass of a vector that starts as a running mean."""

    def __init__(self, memory_s: float) -> None:
        self._gain = CELL_S / memory_s
        self._n = 0
        self.value: Vector = (0.0, 0.0, 0.0)

    def add(self, v: Vector) -> Vector:
        self._n += 1
        a = max(self._gain, 1.0 / self._n)
        m = self.value
        self.value = (m[0] + a * (v[0] - m[0]), m[1] + a * (v[1] - m[1]), m[2] + a * (v[2] - m[2]))
        return self.value


def _angle(a: Vector, b: Vector) -> float:
    cx, cy, cz = a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]
    sine = math.sqrt(cx * cx + cy * cy + cz * cz)
    return math.atan2(sine, a[0] * b[0] + a[1] * b[1] + a[2] * b[2])


class StepDetector:
    """Causal step and stillness detector; ``add`` returns the steps a sample has revealed."""

    def __init__(self, config: StepConfig | None = None) -> None:
        cfg = self.config = config if config is not None else StepConfig()
        if cfg.signal == "impact":
            self._kernel = smoothing_kernel(cfg.smooth_sd_s, cfg.filter_half_width_s)
        else:
            self._kernel = band_pass_kernel(
                cfg.smooth_sd_s, cfg.trend_sd_s, cfg.filter_half_width_s
            )
        self._half = self._kernel.size // 2
        self._wing = max(round(cfg.peak_half_width_s / CELL_S), 1)
        self._decay = math.exp(-CELL_S / cfg.prominence_memory_s)
        self._valley_cells = round(0.8 / CELL_S)
        self._still_cells = max(round(cfg.still_window_s / CELL_S), 2)
        self.reset()

    def reset(self) -> None:
        """Forget the signal, for example after a gap; an unfinished bout is dropped."""
        cfg = self.config
        self._cells = CellAverager()
        self._gravity = _Mean(cfg.gravity_memory_s)
        self._fast, self._slow = _Mean(0.5), _Mean(2.0)
        # rows: signal, vertical, sharpness; a double buffer, so that the window is contiguous
        self._raw = np.zeros((3, 2 * self._kernel.size))
        self._previous_force: Vector | None = None
        self._previous_step: Vector = (0.0, 0.0, 0.0)
        self._count = 0
        self._tilt: deque[float] = deque(maxlen=self._half + self._wing + 1)
        size = self._valley_cells + 2 * self._wing + 1
        self._band: deque[float] = deque(maxlen=size)
        self._vertical: deque[float] = deque(maxlen=size)
        self._sharp: deque[float] = deque(maxlen=size)
        self._level = 0.0
        self._period_s = 0.6
        self._last_peak_ns: int | None = None
        self._end_ns: int | None = None
        self._pending: list[tuple[int, float, float]] = []
        self._previous_peak: int | None = None
        self._in_bout = False
        self._force: deque[Vector] = deque(maxlen=self._still_cells)

    @property
    def acceleration_sd_mps2(self) -> float:
        """Root of the summed per-axis variance over the still window; inf until it is full."""
        n = len(self._force)
        if n < self._still_cells:
            return math.inf
        f = np.array(self._force)
        return math.sqrt(float(np.sum(np.var(f, axis=0))))

    @property
    def still(self) -> bool:
        """The specific force has been constant over the last ``still_window_s``."""
        return self.acceleration_sd_mps2 < self.config.still_acceleration_sd_mps2

    def add(self, stamp_ns: int, specific_force: Vector) -> list[Step]:
        """Add one finite sample (m/s^2, any device orientation) with a later stamp."""
        steps: list[Step] = []
        for centre_ns, mean in self._cells.add(stamp_ns, specific_force):
            steps += self._add_cell(centre_ns, mean)
        return steps

    def _add_cell(self, centre_ns: int, force: Vector) -> list[Step]:
        g = self._gravity.add(force)
        norm = math.sqrt(g[0] * g[0] + g[1] * g[1] + g[2] * g[2])
        if norm < 1e-6:
            return []  # free fall or a dead sensor: no vertical
        self._tilt.append(_angle(self._fast.add(force), self._slow.add(force)))
        self._force.append(force)
        vertical = (force[0] * g[0] + force[1] * g[1] + force[2] * g[2]) / norm - norm
        signal, sharp, late_ns = vertical, 0.0, (self._half + self._wing) * CELL_NS
        if self.config.signal == "impact":
            signal, sharp = self._jerk(force)
            late_ns += CELL_NS // 2  # of the difference of two cells
        size = self._kernel.size
        slot = self._count % size
        self._raw[:, slot] = self._raw[:, slot + size] = (signal, vertical, sharp)
        self._count += 1
        if self._count < size:
            return []
        band = self._raw[:, slot + 1 : slot + 1 + size] @ self._kernel
        self._band.append(float(band[0]))
        self._vertical.append(float(band[1]))
        self._sharp.append(float(band[2]))
        self._level *= self._decay
        return self._peak(centre_ns - late_ns)

    def _jerk(self, force: Vector) -> tuple[float, float]:
        """Norms of the first and second difference of the specific force over a cell [m/s^3]."""
        last = self._previous_force if self._previous_force is not None else force
        self._previous_force = force
        x, y, z = force[0] - last[0], force[1] - last[1], force[2] - last[2]
        u, v, w = self._previous_step
        self._previous_step = (x, y, z)
        second = math.hypot(x - u, y - v, z - w)
        return math.hypot(x, y, z) / CELL_S, second / CELL_S

    def _impact(self, value: float) -> bool:
        """Whether the judged peak of the jerk is a sharp one."""
        if self.config.signal != "impact":
            return True
        w, near = self._wing, 3  # the second difference may peak a little beside the first
        sharpest = max(list(self._sharp)[-1 - w - near : len(self._sharp) - w + near])
        return sharpest >= 2 * math.sin(math.pi * self.config.min_impact_hz * CELL_S) * value

    def _peak(self, stamp_ns: int) -> list[Step]:
        """Judge the band-passed cell at ``stamp_ns``, which now has both its wings."""
        y, w = self._band, self._wing
        if len(y) < 2 * w + 1:
            return []
        value = y[-1 - w]
        if value <= 0 or value < max(list(y)[-1 - 2 * w :]):
            return []
        cfg = self.config
        since = math.inf
        if self._last_peak_ns is not None:
            since = (stamp_ns - self._last_peak_ns) * 1e-9
        recent = self._since_last_peak(since)
        prominence = value - min(self._band[i] for i in recent)
        floor = max(cfg.min_prominence, cfg.prominence_fraction * self._level)
        if (
            since < max(cfg.min_interval_s, cfg.min_interval_fraction * self._period_s)
            or prominence <= floor
            or value < cfg.min_height_fraction * prominence  # rebound after the last step
            or not self._impact(value)
        ):
            return []
        period_s = self._period_s
        steady = since < cfg.max_interval_s
        self._period_s = 0.7 * self._period_s + 0.3 * since if steady else 0.6
        self._level = 0.6 * self._level + 0.4 * prominence if self._level > 0 else prominence
        self._last_peak_ns = stamp_ns
        if self._tilt[0] > cfg.max_tilt_change_rad:
            return []
        bounce = [self._vertical[i] for i in recent]
        lowest = min(range(len(bounce)), key=bounce.__getitem__)
        return self._confirm((stamp_ns, max(bounce[lowest:]) - bounce[lowest], period_s))

    def _since_last_peak(self, since_s: float) -> range:
        """Cells from the last peak, at most 0.8 s back, to the judged one."""
        judged = len(self._band) - 1 - self._wing
        back = min(self._valley_cells, round(min(since_s, 60.0) / CELL_S))
        return range(max(judged - back, 0), judged + 1)

    def _confirm(self, peak: tuple[int, float, float]) -> list[Step]:
        """Steps of a peak: its stamp, bounce [m/s^2] and the typical period before it [s]."""
        limit_ns = round(self.config.max_interval_s * 1e9)
        previous = self._pending[-1][0] if self._pending else self._previous_peak
        if previous is None or peak[0] - previous > limit_ns:
            self._pending, self._in_bout, self._end_ns = [], False, None
        self._pending.append(peak)
        self._previous_peak = peak[0]
        if not self._in_bout and len(self._pending) < self.config.bout_steps:
            return []
        self._in_bout = True
        steps = [self._step(*pending) for pending in self._pending]
        self._pending = []
        return steps

    def _step(self, peak_ns: int, bounce_mps2: float, period_s: float) -> Step:
        end_ns = peak_ns + round(self.config.contact_lag_s * 1e9)
        start_ns = self._end_ns
        if start_ns is None or end_ns - start_ns > LONGEST_STEP * period_s * 1e9:
            start_ns = end_ns - round(period_s * 1e9)
        self._end_ns = end_ns
        cadence_hz = min(max(1e9 / (end_ns - start_ns), _SLOWEST_HZ), _FASTEST_HZ)
        gain = amplitude_response(self._kernel, cadence_hz)
        return Step(start_ns, end_ns, bounce_mps2 / gain)
