"""What the figures of a measurement depend on: when, by which command, on which machine, with which versions."""

from __future__ import annotations

import datetime
import importlib.metadata
import os
import platform
import shlex
import sys
from pathlib import Path
from typing import Any

PACKAGES = ("vlagents-ray", "ray", "numpy", "torch", "jax", "transformers", "lerobot")


def measured_on(program: str = "vlagents-ray") -> dict[str, Any]:
    """Return date, command, machine and versions as JSON values; call it before measuring, as it states the load.

    Args:
        program: The first words of the command, before the arguments of this process.
    """
    return {
        "date": datetime.datetime.now(datetime.timezone.utc).date().isoformat(),
        "command": " ".join([program, shlex.join(sys.argv[1:])]).rstrip(),
        "machine": _machine(),
        "versions": _versions() | {"Python": platform.python_version()},
    }


def _versions() -> dict[str, str]:
    installed = {one.metadata["Name"]: one.version for one in importlib.metadata.distributions()}
    return {name: installed[name] for name in PACKAGES if name in installed}


def _machine() -> dict[str, Any]:
    """Return the machine's description, without host or user names."""
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
