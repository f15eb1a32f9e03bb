"""Draw how the scatter of the RSUs is learned on METIS when all state wrong variances:
python scripts/learned_picture.py [FILE.png]."""

from __future__ import annotations

import sys
import tempfile
from collections import defaultdict
from dataclasses import replace
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure
from netpos.bags import BagReader, codec
from netpos.bags.writer import whole_bag
from netpos.evaluation import evaluate_bag
from netpos.evaluation.pictures import TRACK_COLOURS, save
from netpos.messages.topics import RSU_LEARNED, RSU_MEASUREMENTS, is_tracker_output
from netpos.scenario import load_scenario
from netpos.scenario.offline import simulate_to_bag
from netpos.scenario.replay import replay_bag

FACTORS = (1 / 16, 16.0, 1 / 4, 4.0)
"""Of the variances that the RSUs state, in turn; of the sd, one over the root is to be learned."""
HEARD_S = 10


def state_wrongly(right: Path, wrong: Path) -> dict[str, float]:
    """Copy a bag with other variances; the factor by RSU."""
    make = codec()
    factors: dict[str, float] = {}
    with BagReader(right) as source, whole_bag(wrong, metadata=source.metadata) as out:
        topics = [name for name in source.topics if not is_tracker_output(name)]
        for name in topics:
            info = source.topics[name]
            out.add_topic(name, info.type_name, info.qos)
        for entry in source.messages(topics):
            if entry.topic != RSU_MEASUREMENTS:
                out.write_raw(entry.topic, entry.type_name, entry.cdr, entry.log_time_ns)
                continue
            m = make.measurement_from_msg(entry.message)
            factor = factors.setdefault(m.rsu_id, FACTORS[len(factors) % len(FACTORS)])
            m = replace(m, azimuth_var=m.azimuth_var * factor, toa_var=m.toa_var * factor)
            out.write(RSU_MEASUREMENTS, make.measurement_to_msg(m), entry.log_time_ns)
    return factors


def main() -> None:
    """Simulate, replay with and without learning, print the figures, draw."""
    file = Path(sys.argv[1]) if len(sys.argv) > 1 else Path("learned_metis.png")
    with tempfile.TemporaryDirectory() as scratch:
        folder = Path(scratch)
        simulate_to_bag(load_scenario("metis_madrid"), folder / "simulated")
        factors = state_wrongly(folder / "simulated", folder / "wrong")
        replay_bag(folder / "simulated", folder / "right")
        replay_bag(folder / "wrong", folder / "believed")
        replay_bag(folder / "wrong", folder / "learned", {"learn_errors": True})
        for name in ("right", "believed", "learned"):
            figures = evaluate_bag(folder / name).vues["vue_1"].scored.figures
            print(f"{name}: RMSE {figures.rmse_m:.3f} m, NEES {figures.nees_mean:.2f}")
        make, scatter_by_key = codec(), defaultdict[tuple[str, str], list[float]](list)
        with BagReader(folder / "learned") as bag:
            for entry in bag.messages([RSU_LEARNED]):
                errors = make.rsu_errors_from_msg(entry.message)
                for quantity, scatter in zip(errors.quantities, errors.scatter, strict=True):
                    scatter_by_key[errors.rsu_id, quantity].append(scatter)
    figure = Figure(figsize=(7.0, 4.2))
    axes = figure.add_subplot()
    for (rsu, _), scatter in sorted(scatter_by_key.items()):
        if len(scatter) >= HEARD_S:
            colour = TRACK_COLOURS[FACTORS.index(factors[rsu])]
            axes.plot(np.arange(1, len(scatter) + 1), scatter, color=colour, lw=0.9, alpha=0.8)
    for index, factor in enumerate(FACTORS):
        label = f"sd stated {factor**0.5:g} times the true one"
        axes.axhline(factor**-0.5, color=TRACK_COLOURS[index], ls="--", lw=1.2, label=label)
    axes.set(yscale="log", xlabel="seconds for which the RSU was heard", ylabel="sd over stated")
    axes.set_yticks([0.25, 0.5, 1, 2, 4], ["1/4", "1/2", "1", "2", "4"])
    axes.minorticks_off()
    axes.grid(color="#DDDDDD", lw=0.5)
    axes.legend(fontsize=8, loc="center left", bbox_to_anchor=(1.0, 0.5), frameon=False)
    save(figure, file)
    print(f"wrote {file}")


if __name__ == "__main__":
    main()
