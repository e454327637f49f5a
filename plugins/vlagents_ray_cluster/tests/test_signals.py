"""Tests of the script of a job that receives signals, with fake programs in place of Slurm's and of
Python.
"""

from __future__ import annotations

import os
import signal
import subprocess
from pathlib import Path

import pytest
from eval_fakes import wait_for

from vlagents_ray_cluster.slurm.submission import BODY

# The fake Python of the job prints the address, or acts as the command, which writes its results
# after a signal.
PYTHON = """#!/bin/bash
case "$*" in
  *address) echo 127.0.0.1:1 ;;
  *)
    signals=0
    trap 'signals=$((signals + 1)); echo >>{folder}/signals' TERM
    touch {folder}/running
    until [ "$signals" -gt 0 ] && [ -e {folder}/go ]; do sleep 0.02; done
    echo written >>{folder}/order
    exit {status} ;;
esac
"""
SRUN = """#!/bin/bash
trap 'echo ray >>{folder}/order; exit 0' USR1
trap '' TERM INT
echo $$ >{folder}/ray.pid
while :; do sleep 0.02; done
"""
SCANCEL = """#!/bin/bash
echo cancelled >>{folder}/order
kill -USR1 "$(cat {folder}/ray.pid)"
"""
HEAD = """python={folder}/bin/python
folder={folder}/logs
setup=
resubmit=0
unfinished=75
arguments=(eval)
"""


@pytest.mark.parametrize("status", [0, 1])
@pytest.mark.parametrize("signals", [1, 2, 5])
def test_a_job_ends_after_its_command_however_many_signals_it_gets(
    signals: int, status: int, tmp_path: Path
) -> None:
    """Slurm sends a signal before the time limit, another at the limit, and one if the job is
    cancelled.
    """
    (tmp_path / "bin").mkdir()
    for name, text in {"python": PYTHON, "srun": SRUN, "scancel": SCANCEL}.items():
        program = tmp_path / "bin" / name
        program.write_text(text.format(folder=tmp_path, status=status))
        program.chmod(0o755)
    environment = {
        "SLURM_JOB_ID": "7",
        "SLURM_JOB_NUM_NODES": "1",
        "PATH": f"{tmp_path}/bin:{os.environ['PATH']}",
    }
    script = HEAD.format(folder=tmp_path) + BODY.read_text()
    with subprocess.Popen(
        ["bash", "-c", script], env=os.environ | environment, start_new_session=True
    ) as job:
        wait_for((tmp_path / "running").exists)
        wait_for((tmp_path / "ray.pid").exists)
        arrived = tmp_path / "signals"
        # Signals are sent one after another, since equal pending signals are merged.
        for number in range(1, signals + 1):
            os.killpg(job.pid, signal.SIGTERM)
            wait_for(lambda sent=number: arrived.exists() and len(arrived.read_text()) == sent)  # type: ignore[misc]
        assert job.poll() is None
        (tmp_path / "go").touch()
        assert job.wait(30) == status
    assert (tmp_path / "order").read_text().split() == ["written", "cancelled", "ray"]
