"""Several simulated hosts on one machine for Ray, Slurm and networks, and a Ray cluster over them.

Each host has its own address, host name, processes, shared memory and boot id; a switch connects
the hosts, separately from the machine's network. Links can be limited and cut, and hosts can be
killed. Hosts share the machine's CPUs, memory, files (except /dev/shm, /tmp/ray and /etc/hosts) and
GPUs. Processes in a host end when the host ends, and hosts end when the process that made them ends
in any way. Needs Linux and root.

    with hosts(3) as [head, second, robot], ray_cluster([head, second]) as cluster:
        head.run(["ray", "status"])
        second.limit("1gbit")
        second.cut()
"""

from __future__ import annotations

import contextlib
import os
import secrets
import shutil
import subprocess
import sys
import tempfile
import time
import uuid
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from vlagents_ray.errors import ConfigError, VLAgentsError

_NETWORK = "198.18.0."  # network of RFC 2544 for tests
_TOOLS = ("ip", "tc", "unshare", "nsenter", "setpriv", "mount")
_PORT = 6379  # port of Ray's head, Ray's default: each host has all ports
_BEGIN_S = 10.0
# Time limit, s: an evaluation on four workers took more than 120 s on a busy machine.
_RAY_S = 300.0
# The first process of a host: it ends no process, and waits for orphans, which would otherwise
# remain zombies.
_INIT = "trap : TERM INT; while :; do sleep 86400 & wait $!; done"


class HostFailed(VLAgentsError):
    """A command in a host failed; the message has its output."""


@dataclass(slots=True)
class Host:
    """A host. `number` counts from 1."""

    number: int
    folder: Path  # folder outside the host for the host's private files
    pid: int  # process id of the host's first process, in the outer namespace
    switch: int  # process id of the switch
    # Variables of the host's processes, in addition to this process's.
    environment: dict[str, str] = field(default_factory=dict)
    _keeper: Any = None

    @property
    def name(self) -> str:
        """The host name, with which the other hosts can also connect."""
        return f"host{self.number}"

    @property
    def address(self) -> str:
        """The IPv4 address."""
        return f"{_NETWORK}{self.number}"

    def command(self, command: Sequence[str]) -> list[str]:
        """Return the words that run `command` in this host."""
        spaces = ("--net", "--pid", "--mount", "--uts", "--ipc")
        # Each host has its own /tmp/ray.
        here = ["--", "env", f"--chdir={os.getcwd()}", "-u", "RAY_TMPDIR"]
        settings = [f"{key}={value}" for key, value in self.environment.items()]
        return ["nsenter", f"--target={self.pid}", *spaces, *here, *settings, *command]

    def start(self, command: Sequence[str], **options: Any) -> subprocess.Popen[str]:
        """Start a process of this host, with `subprocess.Popen`'s options."""
        return subprocess.Popen(self.command(command), text=True, **options)

    def run(self, command: Sequence[str], timeout_s: float = _RAY_S) -> str:
        """Run a command, and return its standard output. Raises `HostFailed` if the command fails
        or takes too long.
        """
        return _output(self.command(command), timeout_s)

    def cut(self) -> None:
        """Disconnect the host's network."""
        self._switch(["ip", "link", "set", f"port{self.number}", "down"])

    def heal(self) -> None:
        """Connect the host's network again."""
        self._switch(["ip", "link", "set", f"port{self.number}", "up"])

    def limit(self, rate: str) -> None:
        """Limit the rate of the host's link in each direction, in the notation of `tc`: "1gbit"."""
        shaping = ["root", "tbf", "rate", rate, "burst", "64kb", "latency", "50ms"]
        self._switch(["tc", "qdisc", "replace", "dev", f"port{self.number}", *shaping])
        self.run(["tc", "qdisc", "replace", "dev", "eth0", *shaping])

    def kill(self) -> None:
        """Kill all processes of the host at once, like a power failure."""
        _end(self._keeper, self.pid)

    def _switch(self, command: Sequence[str]) -> None:
        _output(["nsenter", f"--target={self.switch}", "--net", *command], _BEGIN_S)


@contextlib.contextmanager
def hosts(number: int) -> Iterator[list[Host]]:
    """Make `number` hosts that reach only each other. Raises the errors of `require`."""
    require()
    with tempfile.TemporaryDirectory(prefix="hosts-") as top, contextlib.ExitStack() as stack:
        switch = _first_process(stack, ["--net"])
        inside = ["nsenter", f"--target={switch[1]}", "--net"]
        for command in ("ip link add bridge type bridge", "ip link set bridge up"):
            _output([*inside, *command.split()], _BEGIN_S)
        made = []
        for one in range(1, number + 1):
            folder = Path(top) / f"host{one}"
            folder.mkdir()
            keeper, pid = _first_process(
                stack, ["--net", "--uts", "--mount", "--ipc", "--propagation=private"]
            )
            host = Host(one, folder, pid, switch[1], _keeper=keeper)
            _set_up(host, inside, number)
            made.append(host)
        try:
            yield made
        finally:
            # All hosts are killed before the first one is awaited, as each takes a second or two.
            for host in made:
                host._keeper.kill()


def require() -> None:
    """Raise `ConfigError` unless this machine and user can make hosts."""
    if missing := [tool for tool in _TOOLS if shutil.which(tool) is None]:
        raise ConfigError(
            f"hosts: {', '.join(missing)} not found; install iproute2, util-linux and mount"
        )
    tried = subprocess.run(
        ["unshare", "--net", "--mount", "--pid", "--fork", "--mount-proc", "true"],
        capture_output=True,
        text=True,
        check=False,
    )
    if os.geteuid() != 0 or tried.returncode != 0:
        reason = tried.stderr.strip() or "not root"
        raise ConfigError(
            f"hosts: cannot make network and process namespaces ({reason}); run as root"
        )


def _first_process(
    stack: contextlib.ExitStack, spaces: Sequence[str]
) -> tuple[subprocess.Popen[bytes], int]:
    """Start the first process of new namespaces; it ends with `stack` or this process."""
    command = [
        "setpriv",
        "--pdeathsig=KILL",
        "unshare",
        *spaces,
        "--pid",
        "--fork",
        "--kill-child",
        "--mount-proc",
    ]
    keeper = subprocess.Popen([*command, "sh", "-c", _INIT])
    deadline = time.monotonic() + _BEGIN_S
    while (first := _child(keeper.pid)) is None or _runs(first) != "sh":
        if time.monotonic() > deadline or keeper.poll() is not None:
            keeper.kill()
            keeper.wait(_BEGIN_S)
            raise ConfigError("hosts: new namespaces did not start")
        time.sleep(0.01)
    stack.callback(_end, keeper, first)
    return keeper, first


def _child(pid: int) -> int | None:
    try:
        found = Path(f"/proc/{pid}/task/{pid}/children").read_text().split()
    except OSError:
        return None
    return int(found[0]) if found else None


def _runs(pid: int) -> str:
    try:
        return Path(f"/proc/{pid}/comm").read_text().strip()
    except OSError:
        return ""


def _end(keeper: subprocess.Popen[bytes], first: int) -> None:
    """Wait until the namespaces are empty: their first process ends last."""
    keeper.kill()
    keeper.wait(_BEGIN_S)
    deadline = time.monotonic() + _BEGIN_S
    while _runs(first):
        if time.monotonic() > deadline:
            raise HostFailed(f"process {first} of a host does not end")
        time.sleep(0.01)


def _set_up(host: Host, switch: Sequence[str], number: int) -> None:
    port, far = f"port{host.number}", str(host.pid)
    for command in (
        f"ip link add {port} type veth peer name eth0 netns {far}",
        f"ip link set {port} master bridge",
        f"ip link set {port} up",
    ):
        _output([*switch, *command.split()], _BEGIN_S)
    (host.folder / "hosts").write_text(
        "127.0.0.1 localhost\n" + "".join(f"{_NETWORK}{i} host{i}\n" for i in range(1, number + 1))
    )
    (host.folder / "boot_id").write_text(f"{uuid.uuid4()}\n")
    (host.folder / "ray").mkdir()
    Path("/tmp/ray").mkdir(exist_ok=True)
    for command in (
        "ip link set lo up",
        f"ip address add {host.address}/24 dev eth0",
        "ip link set eth0 up",
        # Ray determines a host's own address from the route to the internet.
        "ip route add default dev eth0",
        f"hostname {host.name}",
        f"mount --bind {host.folder / 'hosts'} /etc/hosts",
        f"mount --bind {host.folder / 'boot_id'} /proc/sys/kernel/random/boot_id",
        f"mount --bind {host.folder / 'ray'} /tmp/ray",
        "mount -t tmpfs tmpfs /dev/shm",
    ):
        host.run(command.split(), _BEGIN_S)


def _output(command: Sequence[str], timeout_s: float) -> str:
    try:
        done = subprocess.run(
            list(command),
            capture_output=True,
            text=True,
            check=False,
            timeout=timeout_s,
            stdin=subprocess.DEVNULL,
        )
    except subprocess.TimeoutExpired as error:
        raise HostFailed(f"`{' '.join(command)}`: not done within {timeout_s:g} s") from error
    if done.returncode:
        said = f"{done.stdout}\n{done.stderr}".strip()
        raise HostFailed(f"`{' '.join(command)}` ended with {done.returncode}: {said}")
    return done.stdout


@dataclass(frozen=True, slots=True)
class RayCluster:
    """A Ray cluster over hosts; the first is the head."""

    hosts: list[Host]

    @property
    def head(self) -> Host:
        """The host on which drivers run."""
        return self.hosts[0]

    @property
    def address(self) -> str:
        """The address of the head, for `ray.init` in one of the hosts."""
        return f"{self.head.address}:{_PORT}"

    def python(self, code: str, *arguments: str, timeout_s: float = _RAY_S) -> str:
        """Run a driver at the head, and return its output."""
        return self.head.run([sys.executable, "-c", code, *arguments], timeout_s)

    def join(self, host: Host, cpus: float, **options: str) -> None:
        """Start Ray on `host` with the environment of the head, and join the cluster."""
        host.environment |= self.head.environment
        _ray_start(host, [f"--address={self.address}"], cpus, options)


@contextlib.contextmanager
def ray_cluster(
    hosts: Sequence[Host],
    cpus: float = 2,
    environment: Mapping[str, str] | None = None,
    **options: str,
) -> Iterator[RayCluster]:
    """Start Ray with `cpus` logical CPUs on each host, and with Ray's token.

    `options` are further options of `ray start`; `environment` is the environment of all processes
    that are started in the hosts from now on.
    """
    shared = {
        "RAY_AUTH_MODE": "token",
        "RAY_AUTH_TOKEN": secrets.token_hex(32),
        "RAY_USAGE_STATS_ENABLED": "0",
        "PATH": f"{Path(sys.executable).parent}{os.pathsep}{os.environ['PATH']}",
        **(environment or {}),
    }
    cluster = RayCluster(list(hosts))
    cluster.head.environment |= shared | {"RAY_ADDRESS": cluster.address}
    _ray_start(
        cluster.head, ["--head", f"--port={_PORT}", "--include-dashboard=false"], cpus, options
    )
    for host in hosts[1:]:
        cluster.join(host, cpus, **options)
    yield cluster


def _ray_start(host: Host, how: Sequence[str], cpus: float, options: Mapping[str, str]) -> None:
    # A log monitor would send what workers print to drivers, which here read no logs: a second of
    # CPU time for each host.
    options = {"include_log_monitor": "false", **options}
    command = ["env", "-u", "RAY_ADDRESS", "ray", "start", *how, "--disable-usage-stats"]
    command += [f"--node-ip-address={host.address}", f"--num-cpus={cpus:g}"]
    host.run([*command, *(f"--{key.replace('_', '-')}={value}" for key, value in options.items())])
