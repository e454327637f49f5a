"""The addresses at which the processes of a running server listen."""

from __future__ import annotations

import re
import socket
from dataclasses import dataclass
from pathlib import Path

import psutil
from ray_processes import words


@dataclass(frozen=True)
class Listener:
    """One socket that others can send to."""

    process: str
    kind: str  # "tcp", "udp", "unix"
    host: str  # an address; of Unix sockets the path, or "@" and the name
    port: int = 0

    @property
    def is_local(self) -> bool:
        """Can no other machine reach it?"""
        return self.kind == "unix" or self.host.removeprefix("::ffff:") in ("127.0.0.1", "::1")


def listeners(root: psutil.Process) -> set[Listener]:
    """Of the process that drives the server, and of all that it started."""
    found = set()
    for process in [root, *root.children(recursive=True)]:
        try:
            name = "driver" if process == root else _name(process)
            sockets = process.net_connections("inet")
            unix = _unix(process.pid)
        except (psutil.NoSuchProcess, OSError):  # it has ended
            continue
        for one in sockets:
            if one.status == psutil.CONN_LISTEN or (one.type == socket.SOCK_DGRAM and one.laddr and not one.raddr):
                kind = "tcp" if one.type == socket.SOCK_STREAM else "udp"
                found.add(Listener(name, kind, one.laddr.ip, one.laddr.port))
        found |= {Listener(name, "unix", path) for path in unix}
    return found


def _name(process: psutil.Process) -> str:
    """Of what runs, whatever it is started by."""
    said = words(process) or [process.name()]
    scripts = [Path(word).name for word in said if word.endswith(".py")]
    program = Path(said[0].split()[0]).name
    # Ray's workers call themselves by what they do at the moment: "ray::Class.method".
    return scripts[0] if scripts else program.partition(".")[0] if program.startswith("ray::") else program


def _unix(pid: int) -> set[str]:
    """The Unix sockets of a process that have a name and wait for messages or connections."""
    inodes = set()
    for descriptor in Path(f"/proc/{pid}/fd").glob("*"):
        try:
            if match := re.fullmatch(r"socket:\[(\d+)\]", str(descriptor.readlink())):
                inodes.add(match[1])
        except OSError:
            continue
    found = set()
    for line in Path(f"/proc/{pid}/net/unix").read_text().splitlines()[1:]:
        _, _, _, flags, kind, _, inode, *path = line.split(maxsplit=7)
        accepts, datagram = int(flags, 16) & 0x10000, kind == "0002"
        if inode in inodes and path and (accepts or datagram):
            found.add(path[0])
    return found
