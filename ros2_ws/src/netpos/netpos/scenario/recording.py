"""A recording as a program handles it: write one from values, read one, track it."""

from __future__ import annotations

import os
from collections.abc import Callable, Mapping, Sequence
from typing import Any

from netpos.bags.recording import RecordedValues, write_values
from netpos.messages.values import ImuSample, Odometry, RsuInfo, RsuMeasurement
from netpos.scenario.replay import replay_bag


class Recording(RecordedValues):
    """A bag: its values in recorded order, and what can be done with it.

    The values are read when one of them is first asked for, all at once: the bag must fit into
    memory (about 1 KB a message). A recording can be given wherever a path of a bag is taken.
    """

    def track(
        self,
        bag: os.PathLike[str] | str,
        changes: Mapping[str, Any] | None = None,
        *,
        smooth: bool = False,
        progress: Callable[[int], None] | None = None,
    ) -> Recording:
        """Track every device and write a new bag: all of this one with the new estimates.

        The estimates are those of the live node, to the last bit. Parameters of the tracker are
        those that the bag holds, then ``changes``, such as ``{"learn_errors": True}``.

        Parameters
        ----------
        bag : folder of the new bag
        changes : parameters of the tracker by name
        smooth : also estimate every epoch from all measurements, the later ones too
        progress : called with the number of messages done

        Returns
        -------
        the new bag

        Raises
        ------
        BagError  no measurements, or no parameters of a tracker, are in this bag
        ValueError  a parameter has a wrong name or value
        FileExistsError  ``bag`` exists
        """
        replay_bag(self.path, os.fspath(bag), changes, progress, smooth=smooth)
        return Recording(bag)


def read_bag(path: os.PathLike[str] | str) -> Recording:
    """Open a bag: a folder, or one ``.mcap`` file.

    Raises ``BagError`` for what is no bag, is damaged, or holds other types under names of netpos.
    """
    return Recording(path)


def write_bag(
    path: os.PathLike[str] | str,
    *,
    rsus: Sequence[RsuInfo],
    measurements: Sequence[RsuMeasurement],
    truth: Sequence[Odometry] = (),
    imu: Sequence[ImuSample] = (),
    tracker: Mapping[str, object] | None = None,
    metadata: Mapping[str, str] | None = None,
) -> Recording:
    """Write a recording of your own as a bag; every input may be in any order.

    Measurements of one stamp and device count as one beacon: they get its number, and
    ``expected`` is how many there are.

    Parameters
    ----------
    path : folder of the new bag
    rsus : every RSU of the measurements
    measurements : what they measured
    truth : where the devices really were, where it is known
    imu : samples of the devices' IMUs
    tracker : parameters to track it with, such as ``device_height_m``; the others are defaults
    metadata : how the recording was made, by name; kept in the bag

    Returns
    -------
    the new bag

    Raises
    ------
    BagError  no measurement, a stamp that is not positive, an RSU without RsuInfo, or one that
        measures a device twice at a stamp
    FileExistsError  ``path`` exists
    """
    write_values(
        path,
        rsus=rsus,
        measurements=measurements,
        truth=truth,
        imu=imu,
        tracker=tracker,
        metadata=metadata,
    )
    return Recording(path)
