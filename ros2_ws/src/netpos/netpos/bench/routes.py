"""Monte Carlo over METIS routes: duration, memory, growth with the number of routes."""

from __future__ import annotations

import multiprocessing
import resource
import time
from collections.abc import Sequence
from concurrent.futures import ProcessPoolExecutor

from netpos.bench.common import Result, growth_exponent, within

_WORKERS = 2
_LIMIT_S, _LIMIT_BYTES = 20.0, float(1 << 30)  # for the most routes
_EXPONENT = 1.1


def run_routes(counts: Sequence[int]) -> tuple[list[float], float]:
    """Seconds for each number of routes, and an upper bound of the memory in bytes: the peaks of
    this process and of its workers, with what they share counted for each.

    The routes are those of fokin2020, N_T = 100 with two RSUs, simulated, tracked, scored and
    compared with their bound.
    """
    from netpos.evaluation.work import Work  # noqa: PLC0415
    from netpos.reproduction.fokin2020 import paper as fokin2020  # noqa: PLC0415 - only where it is measured
    from netpos.reproduction.monte_carlo import monte_carlo  # noqa: PLC0415

    experiment = fokin2020.METIS[0][0]
    fokin2020.warm_up()
    seconds = []
    for count in counts:
        start = time.perf_counter()
        with Work(count, 1, _WORKERS) as work:
            monte_carlo(work, experiment)
        seconds.append(time.perf_counter() - start)
    own_rss, worker_rss = (
        1024.0 * resource.getrusage(who).ru_maxrss
        for who in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN)
    )
    return seconds, own_rss + _WORKERS * worker_rss


def routes_in_fresh_process(counts: Sequence[int]) -> tuple[list[float], float]:
    """``run_routes`` in a process that has done nothing before. Another one has compiled the
    kernels by then: the compiler takes more memory than the routes."""
    fresh = multiprocessing.get_context("spawn")
    for some in ((1,), counts):
        with ProcessPoolExecutor(1, mp_context=fresh) as pool:
            result = pool.submit(run_routes, some).result()
    return result


def route_rows(quick: bool) -> list[Result]:
    """A thousand routes (quick: 64) on two processes, started from a fresh one."""
    counts = (16, 32, 64) if quick else (125, 250, 500, 1000)
    seconds, size = routes_in_fresh_process(counts)
    what = f"{counts[-1]} METIS routes, N_T = 100, two RSUs"
    return [
        within(
            what,
            seconds[-1],
            "limit" if not quick else "its share of the limit for 1000",
            _LIMIT_S * counts[-1] / 1000.0,
            1.0,
            note=f"Simulated, tracked, scored and bounded on {_WORKERS} processes.",
        ),
        within(
            f"{what}: memory",
            size / 1e6,
            "limit",
            _LIMIT_BYTES / 1e6,
            1.0,
            unit="MB",
            note="Peaks of all processes added up; pages they share count for each.",
        ),
        within(
            f"time against routes ({', '.join(map(str, counts))}), exponent",
            growth_exponent(counts, seconds),
            "linear",
            1.0,
            _EXPONENT,
            unit="",
            note=f"{', '.join(f'{s:.2f}' for s in seconds)} s.",
        ),
    ]
