"""Papers reproduced: ``reproduce`` runs one, ``PAPERS`` names them.

``frame``        rows, result, worker processes, registry: what every paper plugs into
``experiment``   one seed of a scenario through simulator, filter and bound
``monte_carlo``  many seeds of it
``rows``         filter rows of a whole simulated run
``pictures``     what papers draw
``fokin2020``    the first paper
``dvornikov2017``  several networks, one track: ``network_truth``, ``network_stages``,
               ``network_summary``, ``network_crossing``, ``network_pictures``
"""

from netpos.evaluation.reproduce.frame import PAPERS, Reproduction, Row, reproduce

__all__ = ["PAPERS", "Reproduction", "Row", "reproduce"]
