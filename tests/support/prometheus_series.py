"""What Prometheus would read of the only node of the cluster that this process is in."""

from __future__ import annotations

import re
import urllib.request
from typing import NamedTuple

import ray


class Scraped(NamedTuple):
    """A value of one of our series."""

    name: str  # without Ray's prefix
    tags: dict[str, str]
    value: float

    def key(self, *tags: str) -> str:
        """The name, and those of `tags` that it has, sorted."""
        return " ".join(
            [self.name, *(f"{tag}={self.tags[tag]}" for tag in sorted(tags) if tag in self.tags)]
        )


def scrape() -> list[Scraped]:
    """Read all of our series."""
    (node,) = ray.nodes()
    url = f"http://{node['NodeManagerAddress']}:{node['MetricsExportPort']}/metrics"
    with urllib.request.urlopen(url, timeout=10) as answer:
        text = answer.read().decode()
    lines = re.findall(r"^ray_(vlagents_\w+)\{(.*)\} (\S+)$", text, re.MULTILINE)
    return [
        Scraped(name, dict(re.findall(r'(\w+)="([^"]*)"', tags)), float(value))
        for name, tags, value in lines
    ]
