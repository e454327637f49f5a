"""`report.html`: an evaluation as one page that needs nothing else."""

from vlagents_ray.evaluate.html.page import FILE, write_report
from vlagents_ray.evaluate.html.videos import Videos

__all__ = ["FILE", "Videos", "write_report"]
