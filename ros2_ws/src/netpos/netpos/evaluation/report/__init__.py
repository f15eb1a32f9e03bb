"""One HTML file on one or several recordings: tables, maps, errors.

``report``  reads the bags and fills the page (``page.html``, ``page.js``)
``plots``   maps, errors, integrity, residuals
``tables``  what the page says in rows
``moments`` where the devices were, for the slider of the map
"""

from netpos.evaluation.report.report import bags_in, write_report

__all__ = ["bags_in", "write_report"]
