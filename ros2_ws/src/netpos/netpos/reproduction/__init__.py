"""Papers reproduced: ``reproduce`` runs one, ``PAPERS`` names them.

``frame``        rows, result, registry: what every paper plugs into
``experiment``   one seed of a scenario through simulator, filter and bound
``monte_carlo``  many seeds of it
``rows``         filter rows of a whole simulated run
``segments``     a run from its start to its loss, and on from a first fix
``columns``      an experiment beside the paper's own filter and the default parameters
``paper_filter`` the filter of fokin2020 as the paper gives it

A folder for each paper, ``paper`` in it is the whole: ``fokin2020``, ``petukhov``,
``dvornikov2017``, ``deng2022``.
"""

from netpos.reproduction.frame import PAPERS, Reproduction, Row, reproduce

__all__ = ["PAPERS", "Reproduction", "Row", "reproduce"]
