"""Executors of jobs. All give the same results: every job computes on one thread."""

from __future__ import annotations

import multiprocessing
import os
import signal
from collections.abc import Callable
from concurrent.futures import ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from typing import Any, Protocol

from threadpoolctl import threadpool_limits

LOCAL = "local"  # a cluster of its own on this machine
_RETRIES = 3  # of a job whose worker died


class WorkerDiedError(RuntimeError):
    """A process ended in the middle of a job: killed, or out of memory."""


class Executor(Protocol):
    """Takes jobs, and gives their results when asked for them."""

    def submit(self, job: Callable[[Any, Any], Any], *arguments: Any) -> Callable[[], Any]:
        """Begin ``job(*arguments)``; what is returned waits for the result, and raises what the
        job raises, or ``WorkerDiedError``."""

    def close(self, *, abandon: bool) -> None:
        """End; ``abandon``: without waiting for what runs."""


class Here:
    """This process: a job is run when its result is asked for."""

    def submit(self, job: Callable[[Any, Any], Any], *arguments: Any) -> Callable[[], Any]:
        """See ``Executor``."""
        return lambda: job(*arguments)

    def close(self, *, abandon: bool) -> None:
        """Nothing to end."""


class Processes:
    """Processes forked from this one, so that they share the compiled kernels and start at
    once."""

    def __init__(self, workers: int) -> None:
        fork = multiprocessing.get_context("fork")
        self._pool = ProcessPoolExecutor(workers, mp_context=fork)
        # A Ctrl-C reaches every process of a terminal. The one that starts the others answers, and
        # not before all are there; they keep it blocked.
        signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
        try:
            self._pool.submit(int).result()  # fork now, before a progress display starts a thread
            signal.pthread_sigmask(signal.SIG_UNBLOCK, {signal.SIGINT})
        except BaseException:
            self.close(abandon=True)
            raise

    def submit(self, job: Callable[[Any, Any], Any], *arguments: Any) -> Callable[[], Any]:
        """See ``Executor``."""
        future = self._pool.submit(job, *arguments)

        def wait() -> Any:
            try:
                return future.result()
            except BrokenProcessPool as error:
                raise WorkerDiedError("a worker process died") from error

        return wait

    def close(self, *, abandon: bool) -> None:
        """See ``Executor``."""
        if abandon:
            for process in multiprocessing.active_children():
                process.terminate()
        # The pool would wait for the rest of a result that was being sent.
        self._pool.shutdown(wait=not abandon, cancel_futures=True)


class Cluster:
    """Machines of a Ray cluster, on which netpos is installed in the same version.

    A job whose worker or machine dies is run again elsewhere.
    """

    def __init__(self, address: str) -> None:
        """``address``: "local", "auto", "host:6379" or "ray://host:10001".

        Raises
        ------
        ValueError  Ray is not installed, or nothing answers at the address
        """
        os.environ.setdefault("RAY_USAGE_STATS_ENABLED", "0")
        try:
            import ray  # noqa: PLC0415 - optional
        except ImportError as error:
            raise ValueError("a cluster needs Ray: pip install 'netpos[cluster]'") from error
        options = {"include_dashboard": False} if address == LOCAL else {}
        try:
            ray.init(address=address, log_to_driver=False, logging_level="error", **options)
        except (ConnectionError, ValueError, RuntimeError, TimeoutError) as error:
            raise ValueError(f"no Ray cluster at {address!r}: {error}") from error
        self._ray = ray
        self._died = (ray.exceptions.RaySystemError, ray.exceptions.WorkerCrashedError)
        self._remote = ray.remote(max_retries=_RETRIES)(_on_one_thread)

    def submit(self, job: Callable[[Any, Any], Any], *arguments: Any) -> Callable[[], Any]:
        """See ``Executor``. Results are fetched one by one, so that few are in memory."""
        reference = self._remote.remote(job, *arguments)

        def wait() -> Any:
            try:
                return self._ray.get(reference)
            except (
                self._ray.exceptions.RaySystemError,
                self._ray.exceptions.WorkerCrashedError,
            ) as error:
                raise WorkerDiedError(
                    f"workers of the cluster died, {_RETRIES + 1} times"
                ) from error

        return wait

    def close(self, *, abandon: bool) -> None:
        """Leave the cluster; one that was started here ends."""
        self._ray.shutdown()


def _on_one_thread(job: Callable[[Any, Any], Any], argument: Any, part: Any) -> Any:
    with threadpool_limits(1):
        return job(argument, part)
