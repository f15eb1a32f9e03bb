"""How good a run was: pairing with the truth, figures, consistency, verdicts and pictures.

``evaluate_bag`` does all of it for a recording. Positions are judged in the horizontal plane of
``map`` unless a name says otherwise.
"""

from netpos.evaluation.evaluate import Evaluation, VueEvaluation, evaluate_bag

__all__ = ["Evaluation", "VueEvaluation", "evaluate_bag"]
