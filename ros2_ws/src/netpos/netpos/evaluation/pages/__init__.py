"""The result pages: tables and bar charts rendered from recorded figures.

``recorded``   what the commands measured, read from ``docs/results/recorded/*.json``
``tables``     which recorded figures a table shows, and the table as Markdown
``layout``     ``docs/results/tables.yaml``: every table and chart of the pages
``markers``    where the tables go in a page
``charts``     bar charts
``site``       all pages of a source tree, rendered
"""

from netpos.evaluation.pages.markers import PageError
from netpos.evaluation.pages.site import Site

__all__ = ["PageError", "Site"]
