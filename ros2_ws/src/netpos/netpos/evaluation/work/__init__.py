"""Jobs over seeds, bags or settings: in this process, in several, or on a Ray cluster."""

from netpos.evaluation.work.executors import WorkerDiedError
from netpos.evaluation.work.kept import Kept
from netpos.evaluation.work.work import Progress, Work

__all__ = ["Kept", "Progress", "Work", "WorkerDiedError"]
