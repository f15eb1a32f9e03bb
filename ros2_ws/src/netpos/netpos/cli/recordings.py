"""``netpos recover`` and ``netpos import``."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from netpos.cli.examples import epilog
from netpos.cli.own_recordings import Bag, import_csv, import_ros, tell, three
from netpos.cli.progress import doing

importers = typer.Typer(no_args_is_help=True, help="Turn other people's recordings into bags.")

importers.command("csv", epilog=epilog("import csv"))(import_csv)
importers.command("ros", epilog=epilog("import ros"))(import_ros)


def recover(
    bag: Annotated[Path, typer.Argument(help="Bag whose recorder did not finish.")],
) -> None:
    """Save what a killed recorder left."""
    from netpos.bags.recover import recover as recover_bag  # noqa: PLC0415

    with doing("recovering"):
        found = recover_bag(bag)
    typer.echo(str(found))


@importers.command("ble-aoa", epilog=epilog("import ble-aoa"))
def ble_aoa(
    path: Annotated[Path, typer.Argument(help="Folder with beacons_*.csv and truth_*.csv.")],
    bag: Bag,
    run: Annotated[
        str | None, typer.Option(help="Which run of a folder, as in beacons_RUN.csv.")
    ] = None,
) -> None:
    """Angles of four BLE arrays, Zenodo record 7759557."""
    from netpos.bags.importers.ble_aoa import import_ble_aoa  # noqa: PLC0415

    with doing("importing"):
        counts = import_ble_aoa(path, bag, run=run)
    tell(bag, counts)


@importers.command("uwb-anchors", epilog=epilog("import uwb-anchors"))
def uwb_anchors(
    path: Annotated[Path, typer.Argument(help="Folder with A*.csv and trajectory.csv.")], bag: Bag
) -> None:
    """Ranges of four UWB anchors on a car to a tag."""
    from netpos.bags.importers.uwb_anchors import import_uwb_anchors  # noqa: PLC0415

    with doing("importing"):
        counts = import_uwb_anchors(path, bag)
    tell(bag, counts)


@importers.command("uwb-trolley", epilog=epilog("import uwb-trolley"))
def uwb_trolley(
    path: Annotated[Path, typer.Argument(help="Folder with UWB_*.csv and motion_capture_*.csv.")],
    bag: Bag,
) -> None:
    """Ranges of eight UWB anchors to three tags on a trolley."""
    from netpos.bags.importers.uwb_trolley import import_uwb_trolley  # noqa: PLC0415

    with doing("importing"):
        counts = import_uwb_trolley(path, bag)
    tell(bag, counts)


@importers.command("car-imu-rtk", epilog=epilog("import car-imu-rtk"))
def car_imu_rtk(
    path: Annotated[Path, typer.Argument(help="Folder with imu_*.csv, .tag and gnss_*.pos.")],
    bag: Bag,
    fewest: Annotated[int, typer.Option(help="Fewest stations that hear an epoch.")] = 1,
    nearest: Annotated[int, typer.Option(help="Most stations that hear an epoch.")] = 2,
    seed: Annotated[int, typer.Option(help="Seed of the stations and of their errors.")] = 1,
    mount: Annotated[
        str | None,
        typer.Option(
            metavar="ROLL,PITCH,YAW",
            help="Attitude of the IMU against forward-right-down, deg. Default: the car of run "
            "1934.",
        ),
    ] = None,
    antenna: Annotated[
        str | None,
        typer.Option(
            metavar="X,Y,Z", help="Antenna from the IMU, forward-left-up, m. Default: as above."
        ),
    ] = None,
    clock_offset: Annotated[
        float | None, typer.Option(help="Added to the time of the IMU, s. Default: as above.")
    ] = None,
) -> None:
    """Real IMU and RTK of a car; stations are simulated along its real way (deng2022).

    The mount of the IMU is that of one car, run 1934; another car needs its own.
    """
    from netpos.bags.importers.car_imu_rtk import MOUNT, Mount  # noqa: PLC0415
    from netpos.scenario.recorded_drive import import_car_drive  # noqa: PLC0415

    chosen = Mount(
        attitude_deg=three(mount, "--mount") if mount else MOUNT.attitude_deg,
        lever_arm_m=three(antenna, "--antenna") if antenna else MOUNT.lever_arm_m,
        clock_offset_s=MOUNT.clock_offset_s if clock_offset is None else clock_offset,
    )
    with doing("importing"):
        counts = import_car_drive(
            path, bag, fewest=fewest, nearest=nearest, seed=seed, mount=chosen
        )
    if mount is None:
        typer.echo("the mount of the IMU is that of run 1934; for another car give --mount")
    tell(bag, counts)


def _imu_command(recording_format: str, what: str) -> None:
    epilogue = epilog(f"import {recording_format}")

    @importers.command(recording_format, help=what, epilog=epilogue)
    def command(path: Annotated[Path, typer.Argument(help="The recording.")], bag: Bag) -> None:
        from netpos.bags.importers.imu import import_imu  # noqa: PLC0415

        with doing("importing"):
            counts = import_imu(path, bag, recording_format=recording_format)
        for topic, count in sorted(counts.items()):
            typer.echo(f"  {topic}: {count}")
        typer.echo(f"wrote {bag}; play it into a running pdr_node: ros2 run netpos_bag play {bag}")


_imu_command("waist-imu", "IMU and magnetometer at the waist (data.mat).")
_imu_command("steps-phone", "Phone accelerometer (csv).")
_imu_command("pdr-phone", "Phone IMU and magnetometer (txt).")
