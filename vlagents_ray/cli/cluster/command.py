"""`vlagents-ray up` and `vlagents-ray down`."""

from __future__ import annotations

import contextlib
import os
import select
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Annotated

import typer

from vlagents_ray.cli.console import errors, out
from vlagents_ray.errors import ConfigError, PolicyUnavailable
from vlagents_ray.ray_tools.reaper import marked
from vlagents_ray.ray_tools.warm_cluster import WarmCluster, warm_cluster

_KEEPER = "vlagents_ray.cli.cluster.keeper"
_START_S, _END_S = 300.0, 90.0
_LOOK_S = 0.1


def up_command(
    port: Annotated[int, typer.Option(min=1, max=65535, help="The port of its servers, on 127.0.0.1.")] = 8000,
    idle: Annotated[
        int | None,
        typer.Option(
            "--workers", min=1, help="Processes kept ready for workers of evaluations; default: one a core, at most 8."
        ),
    ] = None,
) -> None:
    """Start a warm Ray cluster on this machine, for `serve` and `eval` with --address auto, until `down`."""
    with errors():
        cluster = warm_cluster()
        if cluster is not None and cluster.is_kept:
            raise ConfigError(
                f"a warm cluster of yours is up already, at {cluster.url}: use it with --address auto, or end it with "
                f"`vlagents-ray down`"
            )
        if cluster is not None:
            _clear(cluster)
        workers = min(os.cpu_count() or 1, 8) if idle is None else idle
        descriptor, log = tempfile.mkstemp(prefix="vlagents-ray-up-", suffix=".log")
        with open(descriptor, "wb") as output:
            keeper = subprocess.Popen(  # noqa: S603 - our own module
                [sys.executable, "-m", _KEEPER, str(port), str(workers)],
                stdin=subprocess.DEVNULL,
                stdout=output,
                stderr=output,
                start_new_session=True,
            )
        try:
            cluster = _started(keeper, Path(log))
        except BaseException:
            keeper.terminate()  # it ends what it has started
            keeper.wait()
            raise
        out.print(
            f"up: `vlagents-ray serve` and `vlagents-ray eval` use it with --address auto; servers at {cluster.url}"
        )
        out.print(f"log: {log}")
        out.print("`vlagents-ray down` ends it")


def down_command() -> None:
    """End the warm Ray cluster of `up`, with the servers and evaluations that run in it."""
    with errors():
        cluster = warm_cluster()
        if cluster is None:
            raise ConfigError("no warm cluster of yours is up on this machine; `vlagents-ray up` starts one")
        with contextlib.suppress(OSError):  # it has ended
            _end_keeper(cluster)
        _clear(cluster)
        out.print("down")


def _end_keeper(cluster: WarmCluster) -> None:
    """Let the keeper end its cluster, if it still keeps it."""
    process = os.pidfd_open(cluster.keeper)  # which stays that of the keeper if another process gets its id
    try:
        if not cluster.is_kept:
            return
        signal.pidfd_send_signal(process, signal.SIGTERM)
        ended, _, _ = select.select([process], [], [], _END_S)
        if not ended:
            signal.pidfd_send_signal(process, signal.SIGKILL)
    finally:
        os.close(process)


def _started(keeper: subprocess.Popen[bytes], log: Path) -> WarmCluster:
    """Wait until the keeper has announced its cluster."""
    deadline = time.monotonic() + _START_S
    while time.monotonic() < deadline:
        cluster = warm_cluster()
        if cluster is not None and cluster.keeper == keeper.pid:
            return cluster
        if keeper.poll() is not None:
            lines = log.read_text(errors="replace").strip().splitlines()
            reason = lines[-1].removeprefix("error ") if lines else "no reason given"
            raise ConfigError(f"the warm cluster did not start: {reason} (log: {log})")
        time.sleep(_LOOK_S)
    raise PolicyUnavailable(f"the warm cluster did not start within {_START_S:g} s; log: {log}")


def _clear(cluster: WarmCluster) -> None:
    """End what is left of a cluster without keeper."""
    deadline = time.monotonic() + _END_S
    while left := marked(str(cluster.folder)):
        if time.monotonic() > deadline:
            raise PolicyUnavailable(f"processes {left} of the warm cluster do not end; look at them with `ps`")
        for process in left:
            with contextlib.suppress(ProcessLookupError):
                os.kill(process, signal.SIGKILL)
        time.sleep(_LOOK_S)
    shutil.rmtree(cluster.folder, ignore_errors=True)
