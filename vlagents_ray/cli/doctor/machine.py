"""The machine: memory, disk, ports, limits. These checks of `doctor` need no package.

Each check is split in two: a function that reads the facts and one that judges them.
"""

from __future__ import annotations

import errno
import os
import re
import resource
import shutil
import socket
import sys
import tempfile
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

GB = 1e9
SHM = Path("/dev/shm")  # noqa: S108 - where Linux has its shared memory, not a temporary file

# Ray 2.60's own rules (ray/_private/ray_constants.py, utils.py, worker.py).
_STORE_SHARE, _STORE_MAX, _STORE_UNCAPPED = 0.3, 200 * GB, 10 * GB
_FILES_WANTED, _FILES_RAISED_TO, _FILES_ENOUGH = 8192, 65536, 4096
_SOCKET_PATH_MAX = 107  # bytes of a Unix socket's path, without its final NUL
_SESSION_SOCKET = "/ray/session_2026-01-01_00-00-00_000000_1234567/sockets/plasma_store"
_DISK_FULL = 0.95


@dataclass(frozen=True, slots=True)
class Check:
    """One row of `vlagents-ray doctor`.

    "fail": serving a policy or evaluating it on `tabletop` will not work here. "warn": something
    optional is missing, or will be slow.
    """

    name: str
    status: Literal["ok", "warn", "fail"]
    detail: str  # what was found
    cure: str = ""  # what to do about it; empty when all is well


def shared_memory() -> Check:
    """Check that /dev/shm is as large as the object store that Ray will make in it."""
    if sys.platform != "linux":
        return Check("shared memory", "ok", f"Ray does not need /dev/shm on {sys.platform}")
    try:
        usage = shutil.disk_usage(SHM)
    except OSError as error:
        return Check("shared memory", "fail", str(error), f"mount a tmpfs on {SHM}")
    return judge_shared_memory(usage.total, usage.free, memory_bytes())


def judge_shared_memory(total: float, free: float, memory: float) -> Check:
    """Judge sizes in bytes: of /dev/shm, of what is free in it, of the memory of the machine or container."""
    store = min(_STORE_SHARE * memory, _STORE_MAX, max(_STORE_UNCAPPED, 0.95 * free))
    detail = f"{free / GB:.1f} of {total / GB:.1f} GB free; Ray's object store takes up to {store / GB:.1f} GB"
    if free >= store:
        return Check("shared memory", "ok", detail)
    need = int(store / GB) + 1
    return Check(
        "shared memory",
        "warn",
        f"{detail}, so Ray will use slow files on disk",
        f"docker run --shm-size={need}g, or as root: mount -o remount,size={need}G {SHM}",
    )


def memory_bytes(limit_file: Path = Path("/sys/fs/cgroup/memory.max")) -> float:
    """Return the memory of the machine in bytes, or the limit of the container (cgroup v2) if that is less."""
    machine = os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES")
    try:
        limit = limit_file.read_text().strip()
    except OSError:
        return machine
    return min(machine, int(limit)) if limit.isdigit() else machine


def temp_dir() -> Check:
    """Check that the folder of Ray's session files has space, and a path short enough for sockets."""
    path = os.environ.get("RAY_TMPDIR") or os.environ.get("TMPDIR") or tempfile.gettempdir()
    try:
        usage = shutil.disk_usage(path)
    except OSError as error:
        return Check("temporary files", "fail", str(error), "set RAY_TMPDIR to a folder that exists")
    return judge_temp_dir(path, usage.total, usage.free)


def judge_temp_dir(path: str, total: float, free: float) -> Check:
    """Judge the `total` and `free` bytes of the file system that holds `path`."""
    detail = f"{path}: {free / GB:.1f} of {total / GB:.1f} GB free"
    cure = "free some space, or set RAY_TMPDIR to a folder on a larger disk"
    length = len(os.fsencode(path)) + len(_SESSION_SOCKET)
    if length > _SOCKET_PATH_MAX:
        return Check(
            "temporary files",
            "fail",
            f"{path}: Ray's socket paths would have {length} bytes, the system allows {_SOCKET_PATH_MAX}",
            f"set RAY_TMPDIR to a folder with at most {_SOCKET_PATH_MAX - len(_SESSION_SOCKET)} characters in its path",
        )
    if free < 1 * GB:
        return Check("temporary files", "fail", detail, cure)
    if free < 5 * GB:
        return Check("temporary files", "warn", f"{detail}; long runs may fill it", cure)
    if free < (1 - _DISK_FULL) * total:
        return Check("temporary files", "warn", f"{detail}; over {_DISK_FULL:.0%} full, Ray stops spilling to it", cure)
    return Check("temporary files", "ok", detail)


def open_files() -> Check:
    """Check that one process may hold as many sockets and files as a server needs."""
    soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    unlimited = sys.maxsize
    return judge_open_files(
        unlimited if soft == resource.RLIM_INFINITY else soft,
        unlimited if hard == resource.RLIM_INFINITY else hard,
    )


def judge_open_files(soft: int, hard: int) -> Check:
    """Judge the limits; Ray raises the soft one by itself, up to the hard one or 65536."""
    effective = max(soft, min(hard, _FILES_RAISED_TO))
    if effective >= _FILES_ENOUGH:
        return Check("open files", "ok", f"{soft} a process, {effective} under Ray")
    return Check(
        "open files",
        "warn",
        f"{effective} a process; many robots or workers at once may run out",
        f"ulimit -Hn {_FILES_WANTED} as root, or LimitNOFILE={_FILES_WANTED} in the service's systemd unit",
    )


def port_free(port: int) -> Check:
    """Check that the TCP port is free; else say which process holds it."""
    with socket.socket(socket.AF_INET, socket.SOCK_STREAM) as probe:
        probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)  # ports that only linger are free
        try:
            probe.bind(("", port))
        except OSError as error:
            if error.errno not in (errno.EADDRINUSE, errno.EACCES):
                raise
            refused = error.errno == errno.EACCES
        else:
            return Check(f"port {port}", "ok", "free")
    other = f"vlagents-ray serve POLICY --port {port + 1 if not refused else 8000}"
    if refused:
        return Check(f"port {port}", "warn", "only root may listen on it", other)
    return Check(f"port {port}", "warn", f"taken by {_holder(port)}", f"stop that, or {other}")


def _holder(port: int) -> str:
    inodes = set(_listening_inodes(port))
    if not inodes:
        return "another process"
    for link in Path("/proc").glob("[0-9]*/fd/*"):
        try:
            held = re.fullmatch(r"socket:\[(\d+)\]", os.readlink(link))
            if held and held[1] in inodes:
                pid = link.parts[2]
                return f"pid {pid} ({Path('/proc', pid, 'comm').read_text().strip()})"
        except OSError:
            continue  # it has ended, or is another user's
    return "another user's process"


def _listening_inodes(port: int) -> Iterator[str]:
    # /proc/net/tcp: "sl local_address rem_address st ... inode", addresses as HEX:HEXPORT, state 0A = LISTEN
    for table in ("/proc/net/tcp", "/proc/net/tcp6"):
        try:
            lines = Path(table).read_text().splitlines()[1:]
        except OSError:
            continue  # not Linux, or no IPv6
        for line in lines:
            columns = line.split()
            if columns[3] == "0A" and int(columns[1].rpartition(":")[2], 16) == port:
                yield columns[9]
