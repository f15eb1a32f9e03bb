"""Schema of a scenario file. Unknown keys are refused; every physical key carries its unit."""

from __future__ import annotations

import math
import os
from collections.abc import Callable, Mapping
from typing import TYPE_CHECKING, Annotated, Any, Literal, Self

import numpy as np
import numpy.typing as npt
from pydantic import Field, model_validator

from netpos.inertial.gait import Gait, GaitModel, walk, walk_legs
from netpos.inertial.imu import ImuModel, MagnetometerModel, interval_ns
from netpos.inertial.pdr_config import PdrConfig
from netpos.radio.clocks import ClockModel
from netpos.radio.noise import generator
from netpos.radio.propagation import UMA_HIGHEST_DEVICE_M
from netpos.scenario.measured import Measurement
from netpos.scenario.places import Rsus, World
from netpos.scenario.section import (
    FileName,
    Finite,
    Interval,
    Name,
    NotNegative,
    Point,
    Positive,
    Section,
    Start,
)
from netpos.scenario.size import check_motion, check_size
from netpos.world.body import BodyMotion
from netpos.world.hills import Hills
from netpos.world.maps import METIS_MADRID
from netpos.world.motion import Leg, Motion, follow, follow_legs
from netpos.world.quadratic import QuadraticMotion
from netpos.world.routes import random_route, rectangle
from netpos.world.wander import Wander

if TYPE_CHECKING:
    from netpos.scenario.recording import Recording

Array = npt.NDArray[np.float64]

NS = 1_000_000_000
LEGS_MAX = 40_000  # of a route
DEVICES_MAX = 100_000  # with the same settings


class _Points(Section):
    """A route along way-points."""

    corner_radius_m: NotNegative = 0.0
    pauses_s: tuple[NotNegative, ...] = ()

    def waypoints(self, rng: np.random.Generator) -> Array:
        """(n, 2) m."""
        raise NotImplementedError

    def drive(
        self, rng: np.random.Generator, speed_mps: float, ramp_mps2: float | None, hills: Hills
    ) -> Motion:
        """A vehicle on this route."""
        return follow(
            self.waypoints(rng),
            speed_mps,
            corner_radius_m=self.corner_radius_m,
            acceleration_mps2=ramp_mps2,
            pauses_s=self.pauses_s,
            hills=hills,
        )

    def walk(self, rng: np.random.Generator, gait: GaitModel) -> Gait:
        """A person on this route."""
        points, radius = self.waypoints(rng), self.corner_radius_m
        return walk(points, gait, corner_radius_m=radius, pauses_s=self.pauses_s)


class RandomRoute(_Points):
    """fokin2020 section 2.4: random turns on the METIS grid."""

    kind: Literal["metis_random"]
    max_crossings: int = Field(default=6, ge=1, le=LEGS_MAX)
    corner_radius_m: NotNegative = Field(default=0.0, lt=METIS_MADRID.block_m / 2)
    pauses_s: tuple[()] = ()  # it never stops

    def waypoints(self, rng: np.random.Generator) -> Array:
        """(n, 2) m."""
        return random_route(METIS_MADRID, rng, self.max_crossings)


class WaypointRoute(_Points):
    """Straight lines between way-points; ``pauses_s`` one per way-point."""

    kind: Literal["waypoints"]
    points: tuple[Point, ...] = Field(min_length=2)

    def waypoints(self, rng: np.random.Generator) -> Array:
        """(n, 2) m."""
        return np.array(self.points)


class RectangleRoute(_Points):
    """Once or more round a rectangle, counter-clockwise from its lower left corner."""

    kind: Literal["rectangle"]
    corner: Point = (0.0, 0.0)
    width_m: Positive
    height_m: Positive
    laps: int = Field(default=1, ge=1, le=LEGS_MAX // 4)

    def waypoints(self, rng: np.random.Generator) -> Array:
        """(n, 2) m."""
        return rectangle(self.corner, self.width_m, self.height_m, laps=self.laps)


class PathLeg(Section):
    """A straight line of ``straight_m``, or an arc of ``radius_m`` that turns by ``arc_deg``, to
    the left if positive."""

    straight_m: Positive | None = None
    arc_deg: Finite | None = None
    radius_m: Positive | None = None

    @model_validator(mode="after")
    def _one_of_both(self) -> Self:
        line, arc = self.straight_m is not None, self.arc_deg is not None
        if line == arc or arc != (self.radius_m is not None) or self.arc_deg == 0.0:
            raise ValueError(
                "a leg is either straight_m, or arc_deg (left > 0, not 0) with radius_m"
            )
        return self

    @property
    def leg(self) -> Leg:
        """Length and turn."""
        if self.straight_m is not None:
            return Leg(self.straight_m)
        assert self.arc_deg is not None
        assert self.radius_m is not None
        turn = math.radians(self.arc_deg)
        return Leg(self.radius_m * abs(turn), turn)


class PathRoute(Section):
    """Straight lines and arcs, each of which goes on from the end of the one before in the same
    direction; ``heading_deg`` is from east counter-clockwise. ``pauses_s``: at the start and at
    the end of each leg."""

    kind: Literal["path"]
    start: Point
    heading_deg: Finite
    legs: tuple[PathLeg, ...] = Field(min_length=1, max_length=LEGS_MAX)
    pauses_s: tuple[NotNegative, ...] = ()

    @property
    def length_m(self) -> float:
        """Of all legs."""
        return math.fsum(leg.leg.length_m for leg in self.legs)

    def drive(
        self, rng: np.random.Generator, speed_mps: float, ramp_mps2: float | None, hills: Hills
    ) -> Motion:
        """A vehicle on this route."""
        return follow_legs(
            self.start,
            math.radians(self.heading_deg),
            [leg.leg for leg in self.legs],
            speed_mps,
            acceleration_mps2=ramp_mps2,
            pauses_s=self.pauses_s,
            hills=hills,
        )

    def walk(self, rng: np.random.Generator, gait: GaitModel) -> Gait:
        """A person on this route."""
        legs, heading = [leg.leg for leg in self.legs], math.radians(self.heading_deg)
        return walk_legs(self.start, heading, legs, gait, pauses_s=self.pauses_s)


class Stretch(Section):
    """A stretch of constant acceleration."""

    duration_s: Positive
    acceleration_mps2: Point = (0.0, 0.0)


class QuadraticRoute(Section):
    """Per axis a curve of the second order, or several in a row (dvornikov2017)."""

    kind: Literal["quadratic"]
    start: Point
    velocity_mps: Point
    stretches: tuple[Stretch, ...] = Field(min_length=1)

    def motion(self) -> QuadraticMotion:
        """The true motion."""
        return QuadraticMotion(
            self.start,
            self.velocity_mps,
            [stretch.duration_s for stretch in self.stretches],
            [stretch.acceleration_mps2 for stretch in self.stretches],
        )


Route = Annotated[
    RandomRoute | WaypointRoute | RectangleRoute | PathRoute | QuadraticRoute,
    Field(discriminator="kind"),
]


class Network(Section):
    """One of several networks: its RSUs answer the beacons of its own times alone, so the networks
    measure at different instants. With ``own_names`` it uses its own names of devices."""

    name: Name
    interval_s: Interval
    phase_s: NotNegative = Field(default=0.0, le=1e6)
    position_sd_m: Positive | None = None
    own_names: bool = False

    @property
    def interval_ns(self) -> int:
        """Time between the network's measurements [integer ns]."""
        return round(self.interval_s * NS)

    @property
    def phase_ns(self) -> int:
        """Time from the start of the run to its first measurement [integer ns]."""
        return round(self.phase_s * NS)


class Device(Section):
    """One device, or ``count`` devices with the same settings and different draws.

    It drives along its route at ``speed_mps``, or a person walks with it there (``gait``).
    ``pdr`` holds parameters of its dead reckoning (``PdrConfig``); with a gait it is worn at the
    waist unless ``placement`` says otherwise. ``antenna_height_m`` is the height of base_link
    where the road is flat, the antenna is at ``lever_arm_m`` in base_link; the road rises and
    falls as a sine in time. ``wander_density_mps2_sqrthz`` adds the integral of white acceleration
    to the drive."""

    count: int = Field(default=1, ge=1, le=DEVICES_MAX)
    route: Route
    speed_mps: Positive | None = None
    wander_density_mps2_sqrthz: Positive | None = None
    gait: GaitModel | None = None
    acceleration_mps2: Positive | None = None
    antenna_height_m: Finite = 0.0
    hill_amplitude_m: NotNegative = 0.0
    hill_period_s: Positive = 180.0
    lever_arm_m: tuple[Finite, Finite, Finite] = (0.0, 0.0, 0.0)
    beacon_interval_s: Interval
    ground_truth_rate_hz: Positive | None = None
    clock: ClockModel = ClockModel()
    imu: ImuModel | None = None
    magnetometer: MagnetometerModel | None = None
    pdr: dict[str, Any] = Field(default_factory=dict)
    initial_pose_sd_m: Positive | None = None

    @property
    def beacon_interval_ns(self) -> int:
        """Beacon interval [integer ns]."""
        return round(self.beacon_interval_s * NS)

    @property
    def walks(self) -> bool:
        """Whether a person carries the device and its IMU gives the steps."""
        return self.gait is not None and self.imu is not None

    @property
    def dead_reckoning(self) -> dict[str, Any]:
        """Parameters of ``PdrConfig``; the declination is known as any map's."""
        known: dict[str, Any] = {"placement": "waist" if self.gait else "carried"}
        if self.magnetometer is not None:
            declination = math.radians(self.magnetometer.declination_deg)
            known["attitude.declination_rad"] = declination
        return {**known, **self.pdr}

    def motion(self, seed: int, vue_id: str) -> BodyMotion:
        """The true motion; a random route is drawn from the stream ``<vue>/route``."""
        if isinstance(self.route, QuadraticRoute):
            return self.route.motion()
        rng = generator(seed, f"{vue_id}/route")
        if self.gait is not None:
            return self.route.walk(rng, self.gait)
        assert self.speed_mps is not None
        hills = Hills(amplitude_m=self.hill_amplitude_m, period_s=self.hill_period_s)
        drive = self.route.drive(rng, self.speed_mps, self.acceleration_mps2, hills)
        if self.wander_density_mps2_sqrthz is None:
            return drive
        rng = generator(seed, f"{vue_id}/wander")
        return Wander(drive, self.wander_density_mps2_sqrthz, self.beacon_interval_s, rng)

    @model_validator(mode="after")
    def _drivable(self) -> Self:
        has_velocity = isinstance(self.route, QuadraticRoute)
        if has_velocity and (self.speed_mps is not None or self.gait is not None):
            raise ValueError("a quadratic route has its own velocity; remove speed_mps and gait")
        if not has_velocity and (self.gait is None) == (self.speed_mps is None):
            raise ValueError(
                "a device needs either speed_mps (it drives) or gait (a person walks with it)"
            )
        if self.wander_density_mps2_sqrthz is not None and (self.imu or self.speed_mps is None):
            raise ValueError(
                "wander_density_mps2_sqrthz is for a device that drives without an imu"
            )
        if self.gait is not None and self.acceleration_mps2 is not None:
            raise ValueError("a gait starts and stops by itself; remove acceleration_mps2")
        if self.pdr:
            PdrConfig.from_mapping(self.dead_reckoning)
        if self.beacon_interval_ns < 1:
            raise ValueError("beacon_interval_s must be at least 1e-9")
        sensors = [sensor for sensor in (self.imu, self.magnetometer) if sensor is not None]
        for rate in [sensor.rate_hz for sensor in sensors]:
            interval_ns(rate)
        if self.ground_truth_rate_hz is not None:
            interval_ns(self.ground_truth_rate_hz)
        check_motion(self)
        smooth = self.motion(0, "vue_1").smooth
        if isinstance(self.route, RandomRoute) and self.gait is None:
            smooth = self.route.corner_radius_m > 0
        if self.imu and not smooth:
            raise ValueError(
                "an imu needs a motion without jumps: give the route a corner_radius_m > 0, or "
                "pauses_s to turn in at its corners, and pauses an acceleration_mps2"
            )
        return self


class Scenario(Section):
    """A whole run. ``max_duration_s`` ends it before the routes do; absent: each device runs to
    the end of its route.

    Network time starts at ``start_s`` (the first stamp; not 0, which ROS reads as "no time").
    ``tracker`` and ``fusion`` hold parameter overrides for the tracker and for the fusion of the
    tracks of several ``networks``; they are not interpreted here.
    """

    name: FileName
    description: str = ""
    seed: int = Field(default=1, ge=0)
    start_s: Start = 1.0
    max_duration_s: Positive | None = None
    world: World = World()
    rsus: Rsus
    measurement: Measurement
    devices: tuple[Device, ...] = Field(min_length=1)
    networks: tuple[Network, ...] = ()
    tracker: dict[str, Any] = Field(default_factory=dict)
    fusion: dict[str, Any] = Field(default_factory=dict)

    @classmethod
    def load(
        cls,
        name_or_path: str,
        seed: int | None = None,
        changes: Mapping[str, object] | None = None,
    ) -> Scenario:
        """Read a scenario by its name (``netpos scenarios`` lists them) or from a YAML file.

        ``seed`` replaces the file's seed. ``changes`` replaces single values before validation,
        keys with dots and list indices: ``{"devices.0.beacon_interval_s": 0.01}``.

        Raises ``ScenarioError`` (a ``ValueError``) for no such scenario, a text that is not YAML,
        unknown or missing keys, and values out of range.
        """
        from netpos.scenario.load import load_scenario  # noqa: PLC0415 - it reads this schema

        return load_scenario(name_or_path, seed, changes)

    def simulate(
        self, bag: os.PathLike[str] | str, *, progress: Callable[[int], None] | None = None
    ) -> Recording:
        """Simulate the run, without ROS, into a new bag: all that a live graph without its
        tracker sends. The same scenario and seed give the same values.

        ``progress`` is called with the number of messages done. Raises ``FileExistsError`` where
        ``bag`` exists.
        """
        from netpos.scenario.offline import simulate_to_bag  # noqa: PLC0415 - needs the schema
        from netpos.scenario.recording import Recording  # noqa: PLC0415

        simulate_to_bag(self, os.fspath(bag), progress=progress)
        return Recording(bag)

    @property
    def start_ns(self) -> int:
        """First stamp [integer ns]."""
        return round(self.start_s * NS)

    @property
    def vue_ids(self) -> tuple[str, ...]:
        """Device names in order: vue_1, vue_2, ..."""
        return tuple(f"vue_{i + 1}" for i in range(sum(d.count for d in self.devices)))

    @property
    def each_device(self) -> tuple[tuple[str, Device], ...]:
        """(name, settings) of every single device."""
        settings = [d for d in self.devices for _ in range(d.count)]
        return tuple(zip(self.vue_ids, settings, strict=True))

    @property
    def walkers(self) -> tuple[str, ...]:
        """Names of the devices that dead reckoning follows."""
        return tuple(vue for vue, device in self.each_device if device.walks)

    @property
    def duration_s(self) -> float:
        """Time from the first stamp to the end of the last device's run [s]."""
        longest = max(device.motion(self.seed, vue).duration_s for vue, device in self.each_device)
        return min(longest, self.max_duration_s or math.inf)

    @model_validator(mode="after")
    def _fits_into_memory(self) -> Self:
        check_size(self)
        return self

    @model_validator(mode="after")
    def _heights_known(self) -> Self:
        highest = max(d.antenna_height_m for d in self.devices)
        if self.measurement.los.probability and highest > UMA_HIGHEST_DEVICE_M:
            raise ValueError(
                f"los.probability needs antenna_height_m of at most {UMA_HIGHEST_DEVICE_M}"
            )
        return self

    @model_validator(mode="after")
    def _networks_agree(self) -> Self:
        names = [network.name for network in self.networks]
        of_rsus = [unit.network for unit in self.rsus.units]
        if not names:
            if self.fusion:
                raise ValueError("fusion needs networks whose tracks are fused")
            return self
        if len(set(names)) < len(names):
            raise ValueError(f"networks must have different names, got {', '.join(names)}")
        if set(of_rsus) != set(names):
            raise ValueError(
                f"networks {', '.join(names)} need RSUs of their own in rsus.units and no others;"
                f" those name {', '.join(sorted(set(of_rsus))) or 'none'}"
            )
        for network in self.networks:
            for device in self.devices:
                step_ns = device.beacon_interval_ns
                if network.interval_ns % step_ns or network.phase_ns % step_ns:
                    raise ValueError(
                        f"interval_s and phase_s of network {network.name} must be multiples of"
                        f" beacon_interval_s ({device.beacon_interval_s:g})"
                    )
        return self

    @model_validator(mode="after")
    def _phases_measurable(self) -> Self:
        if "phase" in self.measurement.quantities:
            single = [unit.id for unit in self.rsus.units if unit.antennas is None]
            if single or self.rsus.layout != "list":
                raise ValueError(
                    "phase is among the quantities: give every RSU in rsus.units its antennas "
                    f"(baseline_wavelengths, uwb_channel); without: {', '.join(single) or 'all'}"
                )
        return self

    @model_validator(mode="after")
    def _maps_agree(self) -> Self:
        random = any(isinstance(d.route, RandomRoute) for d in self.devices)
        if self.world.map != "metis_madrid" and (random or self.rsus.layout == "metis_madrid"):
            raise ValueError(
                "route metis_random and rsus.layout metis_madrid need world.map metis_madrid"
            )
        if self.world.map == "metis_madrid" and self.world.buildings:
            raise ValueError(
                "world.map metis_madrid has its own buildings; remove world.buildings"
            )
        return self
