"""`report.html`: an evaluation as one self-contained page.

Python computes what the page shows. `templates/page.html.j2` is the page, `sections.html.j2` has a macro for each of
its sections, `elements.html.j2` and `charts.html.j2` hold what these share. `report.css` and `report.js` are written
into the page.
"""

from vlagents_ray.evaluate.report.html.episodes import Videos
from vlagents_ray.evaluate.report.html.page import FILE, write_report

__all__ = ["FILE", "Videos", "write_report"]
