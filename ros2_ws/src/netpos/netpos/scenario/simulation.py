"""The one simulator: the nodes and the offline runner draw the same values from it.

All stamps lie on an integer nanosecond grid that starts at the scenario's ``start_s``. Per device
and stamp the order is: initial pose, ground truth, true clock, IMU, magnetometer, beacon."""

from __future__ import annotations

import heapq
from collections.abc import Iterator
from copy import copy
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np
import numpy.typing as npt

from netpos.estimation.sensors.table import readings
from netpos.inertial.imu import NS, ImuSamples, interval_ns, simulate_imu, simulate_magnetometer
from netpos.messages.values import (
    Beacon,
    ClockState,
    Field,
    ImuSample,
    InitialPose,
    MagneticSample,
    Odometry,
    RsuInfo,
    RsuMeasurement,
)
from netpos.radio.clocks import simulate_clock
from netpos.radio.measure import QUANTITIES, TOA, Observations, Sight, Sites, observe
from netpos.radio.noise import generator
from netpos.scenario.build import (
    clock_tones_of,
    errors_of,
    rotations_of,
    rsus_of,
    sight_of,
    sites_of,
    two_way_of,
)
from netpos.scenario.networks import Answering, answering_of
from netpos.scenario.schema import Device, Scenario
from netpos.world.body import BodyState

Array = npt.NDArray[np.float64]
Stamps = npt.NDArray[np.int64]
Event = Odometry | ClockState | Beacon | ImuSample | MagneticSample | InitialPose

_READINGS = {r.quantity: r for _, r in readings() if r.simulated is not None}
_FIELDS = {"position": Field.POSITION, **{name: r.field for name, r in _READINGS.items()}}


@dataclass(frozen=True, slots=True, kw_only=True)
class Beacons:
    """All beacons of a device: stamp_ns (n,), antenna position (n, 3) m, velocity (n, 2) m/s,
    clock offset (n,) s, drift (n,) s/s."""

    stamp_ns: Stamps
    position: Array
    velocity: Array
    clock_offset_s: Array
    clock_drift: Array


class Simulation:
    """Simulation of a scenario. Every method gives the same values when called again."""

    def __init__(self, scenario: Scenario) -> None:
        self.scenario = scenario
        self.rsus: tuple[RsuInfo, ...] = rsus_of(scenario)
        """The RSUs, in the order of ``Observations.rsu``."""
        quantities = scenario.measurement.quantities
        self.fields = Field(sum(_FIELDS[q] for q in quantities))
        """The quantities every measurement carries."""
        self._carried = [
            (r.value, r.variance, QUANTITIES.index(str(r.simulated)))
            for name, r in _READINGS.items()
            if name in quantities
        ]
        self._rotations = rotations_of(self.rsus)
        self._errors = errors_of(scenario)
        self._sights = {vue: sight_of(scenario, device) for vue, device in scenario.each_device}
        self._place_devices()

    def _place_devices(self) -> None:
        self._answering = answering_of(self.scenario, self.rsus)
        tones = clock_tones_of(self.scenario, self.rsus)
        two_way = two_way_of(self.scenario)
        self._vues = {
            vue: _Vue(
                self.scenario,
                vue,
                device,
                sites_of(self.rsus, self._rotations, tones, self.scenario.seed, vue, two_way),
                self._sights[vue],
            )
            for vue, device in self.scenario.each_device
        }

    def with_seed(self, seed: int) -> Simulation:
        """The same scenario under another seed (>= 0), without building the world anew; for many
        runs. A grid of RSUs has other heights."""
        if self.scenario.rsus.grid is not None:
            return Simulation(self.scenario.model_copy(update={"seed": seed}))
        other = copy(self)
        other.scenario = self.scenario.model_copy(update={"seed": seed})
        other._place_devices()
        return other

    def events(self) -> Iterator[Event]:
        """Everything the devices emit, in time order."""
        streams = [s for vue in self._vues.values() for s in vue.streams()]
        return heapq.merge(*streams, key=lambda event: event.stamp_ns)

    def measure(self, beacon: Beacon) -> list[RsuMeasurement]:
        """What the RSUs report of a beacon, nearest RSU first; ``expected`` is their number.

        Raises
        ------
        ValueError  unknown device, or a position, clock offset or stamp that is not finite or
            negative
        """
        vue = self._vues.get(beacon.vue_id)
        if vue is None:
            raise ValueError(
                f"beacon of unknown device {beacon.vue_id!r}; scenario {self.scenario.name} has "
                f"{', '.join(self._vues)}"
            )
        position = np.asarray(beacon.position, dtype=np.float64).reshape(1, 3)
        what = f"beacon {beacon.sequence} of {beacon.vue_id}"
        if not (np.isfinite(position).all() and np.isfinite(beacon.clock_offset_s)):
            raise ValueError(f"{what} has a position or clock offset that is not finite")
        if not 0 < beacon.stamp_ns < 2**63:
            raise ValueError(f"{what} has no valid stamp: {beacon.stamp_ns} ns")
        return [
            measurement
            for part in self._answering
            if part.answers(beacon.stamp_ns - self.scenario.start_ns)
            for measurement in self._measured_by(part, vue, beacon, position)
        ]

    def _measured_by(
        self, part: Answering, vue: _Vue, beacon: Beacon, position: Array
    ) -> list[RsuMeasurement]:
        seen = observe(
            np.array([beacon.stamp_ns], dtype=np.int64),
            position,
            np.array([beacon.clock_offset_s]),
            part.sites(vue.sites),
            vue.sight,
            self._errors,
        )
        measurements = [
            self._measurement(beacon, part, seen, j) for j in range(int(seen.heard_by[0]))
        ]
        usable = [m for m in measurements if m.fields]
        return [replace(m, expected=len(usable)) for m in usable]

    def warm_up(self) -> None:
        """Compile the measurement kernel, so that the first beacon does not wait for it."""
        vue = next(iter(self._vues.values()))
        observe(
            np.zeros(0, dtype=np.int64),
            np.zeros((0, 3)),
            np.zeros(0),
            vue.sites,
            vue.sight,
            self._errors,
        )

    def beacons(self, vue_id: str) -> Beacons:
        """All beacons of a device as arrays; the same values as in ``events``."""
        return self._vues[vue_id].beacons

    def observations(self, vue_id: str) -> Observations:
        """All measurements of a device as arrays; the same values as of ``measure``. For many runs
        this is the fast way."""
        vue = self._vues[vue_id]
        b = vue.beacons
        seen: Observations = observe(
            b.stamp_ns, b.position, b.clock_offset_s, vue.sites, vue.sight, self._errors
        )
        return seen

    def imu(self, vue_id: str) -> list[ImuSample]:
        """All samples of a device's IMU; none where it has none."""
        return list(self._vues[vue_id].imu())

    def imu_arrays(self, vue_id: str) -> ImuSamples:
        """All samples of a device's IMU as arrays; the same values as of ``imu``.

        Raises ``ValueError`` for a device without an IMU.
        """
        return self._vues[vue_id].imu_arrays()

    def truth(self, vue_id: str, stamps_ns: Stamps) -> BodyState:
        """The true motion of base_link at stamps (n,)."""
        return self._vues[vue_id].truth(stamps_ns)

    def initial_pose(self, vue_id: str) -> InitialPose | None:
        """Initial position for the tracker, where the scenario asks for one."""
        return self._vues[vue_id].initial_pose

    def _measurement(
        self, beacon: Beacon, part: Answering, seen: Observations, j: int
    ) -> RsuMeasurement:
        scalars: dict[str, Any] = {}
        for value, variance, column in self._carried:
            scalars[value] = float(seen.values[0, j, column])
            scalars[variance] = float(seen.variances[0, j, column])
        rsu_id, nearest = (self.rsus[int(part.rsus[seen.rsu[0, i]])].rsu_id for i in (j, 0))
        fields = self.fields
        if fields & Field.TDOA and j == 0:  # the others count from the nearest
            fields &= ~Field.TDOA
            scalars["tdoa_s"] = scalars["tdoa_var"] = 0.0
        elif fields & Field.TDOA:
            scalars["tdoa_s"] -= float(seen.values[0, 0, TOA])
            scalars["tdoa_var"] += float(seen.variances[0, 0, TOA])
            scalars["reference_rsu_id"] = nearest
        fix, fix_cov = np.zeros(3), np.zeros((3, 3))
        if self.fields & Field.POSITION:
            fix, fix_cov = part.fix(beacon, rsu_id, self.scenario.seed)
        return RsuMeasurement(
            stamp_ns=beacon.stamp_ns,
            rsu_id=rsu_id,
            vue_id=part.names[beacon.vue_id],
            sequence=beacon.sequence,
            expected=int(seen.heard_by[0]),
            fields=fields,
            rssi_dbm=float(seen.rssi_dbm[0, j]),
            position=fix,
            position_cov=fix_cov,
            lever_arm=self._vues[beacon.vue_id].lever_arm_m,
            **scalars,
        )


class _Vue:
    """One device of a simulation."""

    def __init__(
        self, scenario: Scenario, vue_id: str, device: Device, sites: Sites, sight: Sight
    ) -> None:
        self._vue_id = vue_id
        self._device = device
        self._seed = scenario.seed
        self._start_ns = scenario.start_ns
        self._motion = device.motion(scenario.seed, vue_id)
        limit_s = scenario.max_duration_s or self._motion.duration_s
        self._duration_ns = int(min(limit_s, self._motion.duration_s) * NS)
        self._base = np.array([0.0, 0.0, device.antenna_height_m])
        self.lever_arm_m = device.lever_arm_m
        self.sites = sites
        self.sight = sight

    def _grid(self, step_ns: int) -> Stamps:
        return np.arange(self._duration_ns // step_ns + 1, dtype=np.int64) * step_ns

    def _lever(self, state: BodyState) -> Array:
        """(n, 3) from base_link to the antenna in map."""
        if not any(self.lever_arm_m):
            return np.zeros((len(state.position), 3))
        return np.asarray(state.rotation.apply(self.lever_arm_m))

    def truth(self, stamps_ns: Stamps) -> BodyState:
        state = self._motion.body_at((stamps_ns - self._start_ns) / NS)
        return replace(state, position=state.position + self._base)

    @cached_property
    def beacons(self) -> Beacons:
        elapsed = self._grid(self._device.beacon_interval_ns)
        state = self._motion.body_at(elapsed / NS)
        stamps = self._start_ns + elapsed
        offset, drift = simulate_clock(self._device.clock, stamps, self._seed, self._vue_id)
        return Beacons(
            stamp_ns=stamps,
            position=state.position + self._base + self._lever(state),
            velocity=state.velocity[:, :2],
            clock_offset_s=offset,
            clock_drift=drift,
        )

    @cached_property
    def initial_pose(self) -> InitialPose | None:
        sd = self._device.initial_pose_sd_m
        if sd is None:
            return None
        error = sd * generator(self._seed, f"{self._vue_id}/initial_pose").standard_normal(2)
        start = np.array([self._start_ns], dtype=np.int64)
        return InitialPose(
            stamp_ns=self._start_ns,
            vue_id=self._vue_id,
            position=self.truth(start).position[0] + np.array([*error, 0.0]),
            cov=np.diag([sd**2, sd**2, 0.0]),
        )

    def streams(self) -> list[Iterator[Event]]:
        pose = self.initial_pose
        first: Iterator[Event] = iter([pose] if pose else [])
        streams = [first, self._truth(), self._clock()]
        if self._device.imu:
            streams.append(self.imu())
        if self._device.magnetometer:
            streams.append(self._magnetometer())
        return [*streams, self._beacons()]

    def _truth(self) -> Iterator[Event]:
        elapsed = self._grid(self._device.beacon_interval_ns)
        if self._device.ground_truth_rate_hz:
            elapsed = np.union1d(
                elapsed, self._grid(interval_ns(self._device.ground_truth_rate_hz))
            )
        state = self._motion.body_at(elapsed / NS)
        quaternions = state.rotation.as_quat()
        places = state.position + self._base
        velocities = state.rotation.inv().apply(state.velocity)
        for i, stamp in enumerate((self._start_ns + elapsed).tolist()):
            yield Odometry(
                stamp_ns=stamp,
                vue_id=self._vue_id,
                position=places[i],
                quaternion=quaternions[i],
                linear_velocity=velocities[i],
                angular_velocity=state.angular_velocity[i],
            )

    def _clock(self) -> Iterator[Event]:
        b = self.beacons
        for i, stamp in enumerate(b.stamp_ns.tolist()):
            yield ClockState(
                stamp_ns=stamp,
                vue_id=self._vue_id,
                offset_s=float(b.clock_offset_s[i]),
                drift=float(b.clock_drift[i]),
            )

    def imu(self) -> Iterator[ImuSample]:
        """All samples; none without an IMU."""
        if self._device.imu is None:
            return
        imu = self.imu_arrays()
        end_ns = self._start_ns + self._duration_ns
        for i, stamp in enumerate(imu.stamp_ns[imu.stamp_ns <= end_ns].tolist()):
            yield ImuSample(
                stamp_ns=stamp,
                vue_id=self._vue_id,
                angular_velocity=imu.angular_velocity[i],
                specific_force=imu.specific_force[i],
                angular_velocity_var=imu.angular_velocity_var,
                specific_force_var=imu.specific_force_var,
            )

    def imu_arrays(self) -> ImuSamples:
        if self._device.imu is None:
            raise ValueError(f"{self._vue_id} has no imu; give its device one")
        return simulate_imu(
            self._device.imu, self._motion, self._start_ns, self._seed, self._vue_id
        )

    def _magnetometer(self) -> Iterator[Event]:
        model = self._device.magnetometer
        assert model is not None
        stamps, fields = simulate_magnetometer(
            model, self._motion, self._start_ns, self._seed, self._vue_id
        )
        end_ns = self._start_ns + self._duration_ns
        for i, stamp in enumerate(stamps[stamps <= end_ns].tolist()):
            yield MagneticSample(
                stamp_ns=stamp,
                vue_id=self._vue_id,
                magnetic_field=fields[i],
                magnetic_field_var=model.noise_sd_t**2,
            )

    def _beacons(self) -> Iterator[Event]:
        b = self.beacons
        for i, stamp in enumerate(b.stamp_ns.tolist()):
            yield Beacon(
                stamp_ns=stamp,
                vue_id=self._vue_id,
                sequence=i,
                position=b.position[i],
                clock_offset_s=float(b.clock_offset_s[i]),
            )
