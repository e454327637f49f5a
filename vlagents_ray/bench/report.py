"""Everything in one go: what the README's benchmark section is made of."""

from __future__ import annotations

import datetime
import importlib.metadata
import json
import os
import platform
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

from vlagents_ray.bench import link
from vlagents_ray.bench.evaluation import EvaluationPlan, measure_evaluation
from vlagents_ray.bench.markdown import replaced, section
from vlagents_ray.bench.rtt import measure_rtt
from vlagents_ray.bench.throughput import Plan, measure_throughput
from vlagents_ray.errors import ConfigError

COMMAND = "vlagents-ray bench report"


def collect(
    peers_python: Path,
    *,
    calls: int = 1000,
    link_calls: int = 600,
    plan: Plan | None = None,
    tell: Callable[[str], None] = lambda _: None,
) -> dict[str, Any]:
    """Round trips with all peers, the link if this machine can make one, throughput, evaluations; as JSON values."""
    results: dict[str, Any] = {
        "date": datetime.datetime.now(datetime.timezone.utc).date().isoformat(),
        "command": COMMAND,
        "machine": machine(),
        "versions": {name: importlib.metadata.version(name) for name in ("vlagents-ray", "ray", "numpy")}
        | {"Python": platform.python_version()},
        "skipped": {},
    }
    results["rtt"] = measure_rtt(calls, peers=["all"], peers_python=peers_python, tell=tell).to_json()
    results["versions"] |= results["rtt"]["versions"]
    try:
        results["link"] = link.measure_link(link_calls, peers=link.PEERS, peers_python=peers_python, tell=tell)
    except ConfigError as error:
        tell(str(error))
        results["skipped"]["link"] = str(error)
    results["throughput"] = measure_throughput(plan or Plan(), tell)
    results["evaluation"] = measure_evaluation(EvaluationPlan(), peers=["all"], peers_python=peers_python, tell=tell)
    return results


def machine() -> dict[str, Any]:
    """What the figures depend on; no names."""
    cpu = platform.processor() or platform.machine()
    for line in Path("/proc/cpuinfo").read_text().splitlines():
        if line.startswith("model name"):
            cpu = line.partition(":")[2].strip()
            break
    memory = os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES")
    return {
        "cpu": cpu,
        "cores": os.cpu_count(),
        "memory_gb": round(memory / 2**30),
        "kernel": platform.release().partition("-")[0],
        "load": os.getloadavg()[0],
    }


def write(results: Mapping[str, Any], readme: Path, json_file: Path | None) -> None:
    """The section into the README; the figures, from which it can be made again, into `json_file`."""
    text = replaced(readme.read_text(), section(results))
    if json_file is not None:
        json_file.parent.mkdir(parents=True, exist_ok=True)
        json_file.write_text(json.dumps(results, indent=1) + "\n")
    readme.write_text(text)
