"""A Slurm for a test: its controller on one host and slurmd on others, with a separate key and
separate files.
"""

from __future__ import annotations

import contextlib
import re
import secrets
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

from eval_fakes import PYTHONPATH, wait_for
from simulated_hosts import Host, HostFailed, hosts

_TOOLS = ("munged", "slurmctld", "slurmd", "sbatch", "srun", "scontrol", "squeue", "scancel")
_READY_S = 60.0
# Longest wait for a job, s. Beside 12 other processes on two cores, the start of Ray on two nodes
# took more than 180 s.
_JOB_S = 300.0
ENDED = {"CANCELLED", "COMPLETED", "FAILED", "NODE_FAIL", "OUT_OF_MEMORY", "TIMEOUT"}
_CONFIGURATION = """
ClusterName=test
SlurmctldHost={head.name}({head.address})
SlurmUser=root
SlurmdUser=root
AuthType=auth/munge
# A requeued job begins so many s later: when what is left of its earlier life has been killed (KillWait).
AuthInfo=socket={folder}/munge.socket,cred_expire=20
ProctrackType=proctrack/linuxproc
TaskPlugin=task/none
SelectType=select/cons_tres
SelectTypeParameters=CR_CPU
GresTypes=gpu
MpiDefault=none
ReturnToService=2
KillWait=10
CompleteWait=0
SchedulerParameters=batch_sched_delay=0,sched_interval=2
AccountingStorageType=accounting_storage/none
StateSaveLocation={folder}/state
SlurmdSpoolDir={folder}/spool-%n
SlurmctldPidFile={folder}/slurmctld.pid
SlurmdPidFile={folder}/slurmd-%n.pid
SlurmctldLogFile={folder}/slurmctld.log
SlurmdLogFile={folder}/slurmd-%n.log
{nodes}
PartitionName=all Nodes=ALL Default=YES MaxTime=60 DefaultTime=10
"""


def no_slurm() -> str | None:
    """Return the reason why tests cannot run Slurm here; None if they can."""
    missing = [tool for tool in _TOOLS if shutil.which(tool) is None]
    return f"{', '.join(missing)} not found; install slurm-wlm and munge" if missing else None


@dataclass(frozen=True, slots=True)
class Slurm:
    """A running Slurm. Jobs are submitted at `login`, which is not a node."""

    login: Host
    nodes: list[Host]

    def vlagents_ray(self, *words: str) -> str:
        """Run `vlagents-ray` where jobs are submitted, and return its output."""
        return self.login.run(
            [sys.executable, "-c", "from vlagents_ray.cli import main; main()", *words]
        )

    def do(self, *command: str) -> str:
        """Run a command of Slurm where jobs are submitted, and return its output."""
        return self.login.run(command)

    def state(self, job: str) -> str:
        """Return the state of a job: PENDING, RUNNING, COMPLETED, …"""
        return self.do(
            "squeue", "--noheader", "--format=%T", "--states=all", f"--jobs={job}"
        ).strip()

    def wait_for_end(self, job: str, timeout_s: float = _JOB_S) -> str:
        """Wait until the job is over, and return its last state."""
        self.wait_for(job, lambda: self.state(job) in ENDED, timeout_s)
        return self.state(job)

    def wait_for(self, job: str, true: Callable[[], bool], timeout_s: float = _JOB_S) -> None:
        """Poll until `true()`; after the time limit, raise an error with Slurm's information about
        the job.
        """
        try:
            wait_for(true, timeout_s, every_s=0.2)
        except TimeoutError as error:
            shown = self.do("scontrol", "show", "job", job)
            [log] = re.findall(r"StdOut=(.*)", shown)
            log_text = Path(log).read_text()[-3000:] if Path(log).exists() else "nothing"
            raise AssertionError(f"job {job}:\n{shown}\nits log:\n{log_text}") from error


@contextlib.contextmanager
def running_slurm(nodes: int, cpus: int) -> Iterator[Slurm]:
    """Yield a cluster with this number of nodes, each with this number of CPUs as far as Slurm
    knows; it ends with the context.
    """
    folder = Path(tempfile.mkdtemp(prefix="slurm-"))
    try:
        with hosts(nodes + 1) as [login, *node_hosts]:
            (folder / "munge.key").write_bytes(secrets.token_bytes(128))
            (folder / "munge.key").chmod(0o600)
            lines = []
            for node in node_hosts:
                resources = f"CPUs={cpus} Gres=gpu:1 State=UNKNOWN"
                lines.append(f"NodeName={node.name} NodeAddr={node.address} {resources}")
            configuration = folder / "slurm.conf"
            configuration.write_text(
                _CONFIGURATION.format(head=login, folder=folder, nodes="\n".join(lines))
            )
            # Slurm counts a GPU, which does not exist.
            (folder / "gres.conf").write_text("Name=gpu File=/dev/null\n")
            for host in (login, *node_hosts):
                host.environment |= {
                    "SLURM_CONF": str(configuration),
                    "PYTHONPATH": f"{PYTHONPATH}:{Path(__file__).parent}",
                }
                (folder / f"spool-{host.name}").mkdir()
            slurm = Slurm(login, node_hosts)
            (folder / "state").mkdir()
            with _daemons(slurm, folder):
                yield slurm
    finally:
        shutil.rmtree(folder, ignore_errors=True)


@contextlib.contextmanager
def _daemons(slurm: Slurm, folder: Path) -> Iterator[None]:
    files = [f"--{name}-file={folder}/munge.{name}" for name in ("key", "log", "pid", "seed")]
    munged = ["munged", "--foreground", "--force", f"--socket={folder}/munge.socket", *files]
    with contextlib.ExitStack() as stack:

        def start(host: Host, command: Sequence[str]) -> None:
            quiet = {
                "stdin": subprocess.DEVNULL,
                "stdout": subprocess.DEVNULL,
                "stderr": subprocess.DEVNULL,
            }
            process = host.start(command, **quiet)
            stack.callback(process.wait, 20)
            stack.callback(process.kill)  # the processes that it started in the host end with it

        start(slurm.login, munged)
        _until((folder / "munge.socket").exists, folder)
        start(slurm.login, ["slurmctld", "-D"])
        for node in slurm.nodes:
            start(node, ["slurmd", "-D", "-N", node.name])
        _until(lambda: _idle(slurm) == len(slurm.nodes), folder)
        yield


def _idle(slurm: Slurm) -> int:
    try:
        return slurm.do("sinfo", "--noheader", "--Node", "--format=%t").split().count("idle")
    except HostFailed:  # slurmctld does not answer yet
        return 0


def _until(true: Callable[[], bool], folder: Path) -> None:
    try:
        wait_for(true, _READY_S, every_s=0.1)
    except TimeoutError as error:
        logs = "\n".join(f"{log.name}:\n{log.read_text()[-3000:]}" for log in folder.glob("*.log"))
        raise AssertionError(f"Slurm does not start:\n{logs}") from error
