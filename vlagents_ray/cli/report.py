"""`vlagents-ray report`: folders of results as one page."""

from __future__ import annotations

from enum import Enum
from pathlib import Path
from typing import Annotated

import typer

from vlagents_ray.cli.console import errors, out


class Videos(str, Enum):
    """Where the page's videos are."""

    INLINE = "inline"
    LINK = "link"
    NONE = "none"


def report_command(
    folders: Annotated[list[Path], typer.Argument(metavar="OUT...", help="Folders that evaluations wrote to.")],
    html: Annotated[
        Path | None, typer.Option(help="The file to write; default: report.html in OUT, with several here.")
    ] = None,
    videos: Annotated[
        Videos, typer.Option(help="In the page as far as they fit, beside it, or stills alone.")
    ] = Videos.LINK,
) -> None:
    """Write a page of what came out: success with intervals, comparisons, latency, failures, and all that made it."""
    from vlagents_ray.evaluate import Results
    from vlagents_ray.evaluate.combining import combined
    from vlagents_ray.evaluate.html import FILE, write_report

    with errors():
        results = combined([Results.load(folder) for folder in folders])
        path = html or (folders[0] / FILE if len(folders) == 1 else Path(FILE))
        written = write_report(results, path, videos=videos.value)
        out.print(f"report: {written}", markup=False, highlight=False, soft_wrap=True)
