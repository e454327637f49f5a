"""The metrics that Prometheus would read from the only node of this process's Ray cluster."""

from __future__ import annotations

import re
import urllib.request
from typing import NamedTuple

import ray


class Scraped(NamedTuple):
    """A value of one of this package's metrics."""

    name: str  # the name without Ray's prefix
    tags: dict[str, str]
    value: float

    def key(self, *tags: str) -> str:
        """Return the name and the sorted values of `tags` that the metric has."""
        return " ".join(
            [self.name, *(f"{tag}={self.tags[tag]}" for tag in sorted(tags) if tag in self.tags)]
        )


def scrape() -> list[Scraped]:
    """Read all metrics of this package."""
    (node,) = ray.nodes()
    url = f"http://{node['NodeManagerAddress']}:{node['MetricsExportPort']}/metrics"
    with urllib.request.urlopen(url, timeout=10) as answer:
        text = answer.read().decode()
    lines = re.findall(r"^ray_(vlagents_\w+)\{(.*)\} (\S+)$", text, re.MULTILINE)
    return [
        Scraped(name, dict(re.findall(r'(\w+)="([^"]*)"', tags)), float(value))
        for name, tags, value in lines
    ]
