"""Papers reproduced: ``reproduce`` runs one, ``PAPERS`` names them.

``frame``        rows, result, registry: what every paper plugs into
``experiment``   one seed of a scenario through simulator, filter and bound
``monte_carlo``  many seeds of it
``rows``         filter rows of a whole simulated run
``pictures``     what papers draw
``segments``     a run from its start to its loss, and on from a first fix
``columns``      an experiment beside the paper's own filter and the default parameters
``fokin2020``    the first paper: ``fokin_rows``, ``paper_filter``, ``metis_calibration``
``dvornikov2017``  several networks, one track: ``network_truth``, ``network_stages``,
               ``network_summary``, ``network_crossing``, ``network_pictures``
"""

from netpos.evaluation.reproduce.frame import PAPERS, Reproduction, Row, reproduce

__all__ = ["PAPERS", "Reproduction", "Row", "reproduce"]
