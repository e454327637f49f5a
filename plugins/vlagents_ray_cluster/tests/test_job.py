"""Tests of a job in Slurm: its use of Slurm's variables, its end, and the connection info of its
server.
"""

from __future__ import annotations

import contextlib
import datetime
import json
import os
import signal
import socket
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest
from eval_fakes import wait_for

from vlagents_ray_cluster.slurm import job
from vlagents_ray_cluster.slurm.job import (
    HEAD,
    Allocation,
    Ports,
    as_text,
    connection_info,
    end_of_job,
    write,
)

ENVIRONMENT = {
    "SLURM_JOB_ID": "4711",
    "SLURM_JOB_NUM_NODES": "3",
    "SLURM_NODEID": "1",
    "SLURM_CPUS_ON_NODE": "1",
}


def options(**more: str) -> dict[str, str]:
    """Return the options of `ray start` by name."""
    words = Allocation.here(ENVIRONMENT | more).ray_start("10.0.0.5", "/tmp/x")
    assert words[:2] == ["ray", "start"]
    return dict(word.removeprefix("--").partition("=")[::2] for word in words[2:])


def test_ray_gets_what_slurm_gave_and_not_what_the_machine_has() -> None:
    ray_options = options(SLURM_GPUS_ON_NODE="2", SLURM_MEM_PER_NODE="8192")
    assert (ray_options["num-cpus"], ray_options["num-gpus"]) == ("1", "2")
    assert int(ray_options["memory"]) + int(ray_options["object-store-memory"]) == 8192 * 2**20


def test_memory_may_be_counted_by_cpu_or_not_at_all() -> None:
    ray_options = options(SLURM_MEM_PER_CPU="4096")
    assert int(ray_options["memory"]) + int(ray_options["object-store-memory"]) == 4096 * 2**20
    for more in ({}, {"SLURM_MEM_PER_NODE": "0"}):
        assert "memory" not in options(**more)


def test_a_task_that_is_bound_to_fewer_cpus_counts_those() -> None:
    assert Allocation.here(ENVIRONMENT | {"SLURM_CPUS_ON_NODE": "9999"}).cpus == len(
        os.sched_getaffinity(0)
    )


def test_the_first_node_is_the_head_and_the_others_join_it() -> None:
    head, worker = options(SLURM_NODEID="0"), options()
    assert {"head", "block"} <= head.keys()
    assert head["node-ip-address"] == "10.0.0.5"
    assert worker["address"] == f"10.0.0.5:{head['port']}"
    assert "head" not in worker


@pytest.mark.parametrize("job", [1, 4711, 2_499, 67_043_328])
def test_jobs_that_follow_each_other_share_no_port(job: int) -> None:
    def ports(number: int) -> Ports:
        return Allocation.here(ENVIRONMENT | {"SLURM_JOB_ID": str(number)}).ports

    def numbers(job_ports: Ports) -> set[int]:
        return {
            job_ports.gcs,
            job_ports.client,
            job_ports.metrics,
            job_ports.serve,
            job_ports.export,
        }

    assert len(numbers(ports(job))) == 5
    assert not numbers(ports(job)) & numbers(ports(job + 1))
    assert all(10_000 <= port < 20_000 for port in numbers(ports(job)))


def test_rays_own_folder_which_it_opens_to_everybody_is_within_that_of_the_job() -> None:
    assert options()["temp-dir"] == "/tmp/x/ray"


def squeue_says(text: str, folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    file = folder / "squeue"
    file.write_text(f"#!/bin/bash\necho '{text}'\n")
    file.chmod(0o755)
    monkeypatch.setenv("PATH", f"{folder}{os.pathsep}{os.environ['PATH']}")


def test_the_end_of_a_job_is_slurms_local_time(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    squeue_says("2027-01-31T18:30:00", tmp_path, monkeypatch)
    assert end_of_job(1) == datetime.datetime(2027, 1, 31, 18, 30).timestamp()


def test_a_job_without_a_limit_has_no_end(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    squeue_says("NONE", tmp_path, monkeypatch)
    assert end_of_job(1) is None


def test_a_newer_slurm_has_said_it_by_a_variable(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("SLURM_JOB_END_TIME", "1801500000")
    assert end_of_job(1) == 1801500000.0


SERVER = {
    "SLURM_JOB_ID": "12",
    "SLURM_SUBMIT_HOST": "login1",
    "SLURM_JOB_USER": "me",
    "VLAGENTS_RAY_HEAD": "10.0.0.5",
    "VLAGENTS_RAY_API_KEY": "vlr_x",
}


def test_the_connection_information_has_all_that_a_client_needs() -> None:
    host = socket.gethostname()
    info = connection_info({"pi0": "/pi0", "noop": "/"}, 9000, SERVER)
    assert info["apps"] == {"pi0": f"http://{host}:9000/pi0", "noop": f"http://{host}:9000"}
    assert (info["job"], info["key"], info["address"]) == (12, "vlr_x", "10.0.0.5")
    assert info["ssh"] == f"ssh -N -L 9000:{host}:9000 me@login1"

    started = Allocation.here(ENVIRONMENT | SERVER).ray_start("10.0.0.5", "folder")
    [exported] = [
        word.partition("=")[2] for word in started if word.startswith("--metrics-export-port=")
    ]
    assert info["metrics"] == f"http://{host}:{exported}/metrics"


def test_people_are_told_the_same() -> None:
    info = connection_info({"pi0": "/pi0"}, 9000, SERVER)
    text = as_text(info, Path("server.json"))
    assert all(expected in text for expected in (info["apps"]["pi0"], info["ssh"], "server.json"))
    assert "the key that you were given" in as_text(info | {"key": None}, Path("server.json"))


def test_the_log_has_no_key_but_the_command_that_reads_it(tmp_path: Path) -> None:
    info = connection_info({"pi0": "/pi0"}, 9000, SERVER)
    file = tmp_path / 'it\'s "here"' / "server.json"
    file.parent.mkdir()
    write(file, info)

    text = as_text(info, file)
    assert "vlr_x" not in text
    (command,) = (line.strip() for line in text.splitlines() if "export" in line)
    shell = subprocess.run(
        ["bash", "-c", f"{command}; echo $VLAGENTS_RAY_API_KEY"],
        check=True,
        capture_output=True,
        text=True,
    )
    assert shell.stdout.strip() == "vlr_x"


def test_the_file_with_the_key_is_its_owners_alone(tmp_path: Path) -> None:
    write(tmp_path / "server.json", {"key": "vlr_x"})
    assert (tmp_path / "server.json").stat().st_mode & 0o777 == 0o600
    assert json.loads((tmp_path / "server.json").read_text()) == {"key": "vlr_x"}


# In place of `ray`: it does not start as often as the folder says; then it runs until SIGTERM.
RAY = """#!/bin/bash
echo start >>{folder}/attempts
for word; do case "$word" in --temp-dir=*) files=${{word#--temp-dir=}} ;; esac; done
if [ "$(wc -l <{folder}/attempts)" -le {failures} ]; then exit 1; fi
mkdir -p "$files"
echo 127.0.0.1:1 >"$files/ray_current_cluster"
trap 'exit 0' TERM
if [ -n "{ends}" ]; then exit 1; fi
echo >{folder}/runs
while :; do sleep 0.02; done
"""


@contextlib.contextmanager
def running_node(
    folder: Path, *, failures: int = 0, ends: bool = False
) -> Iterator[subprocess.Popen[str]]:
    """Run the program of the first node, with a Ray that fails to start `failures` times."""
    program = folder / "bin" / "ray"
    program.parent.mkdir()
    program.write_text(RAY.format(folder=folder, failures=failures, ends="1" if ends else ""))
    program.chmod(0o755)
    environment = os.environ | ENVIRONMENT | {"SLURM_NODEID": "0", HEAD: "127.0.0.1"}
    environment["PATH"] = f"{program.parent}:{environment['PATH']}"
    with subprocess.Popen(
        [sys.executable, "-m", "vlagents_ray_cluster.slurm.job", "node"],
        env=environment,
        stdout=subprocess.PIPE,
        text=True,
    ) as process:
        try:
            yield process
        finally:
            process.kill()


def attempts(folder: Path) -> int:
    return len((folder / "attempts").read_text().splitlines())


def test_a_ray_that_does_not_start_on_a_busy_node_is_started_again(tmp_path: Path) -> None:
    with running_node(tmp_path, failures=2) as process:
        wait_for((tmp_path / "runs").exists, 60)
        process.send_signal(signal.SIGTERM)
        printed, _ = process.communicate(timeout=60)
    assert (process.returncode, attempts(tmp_path)) == (0, 3)
    assert "Ray ended with 1 while it started, trying again (attempt 2 of 3)" in printed


@pytest.mark.parametrize(
    ("failures", "number"), [(99, 3), (0, 1)], ids=["never starts", "ends later"]
)
def test_a_head_whose_ray_does_not_start_or_ends_later_ends_the_job(
    failures: int, number: int, tmp_path: Path
) -> None:
    with running_node(tmp_path, failures=failures, ends=True) as process:
        printed, _ = process.communicate(timeout=60)
    assert (process.returncode, attempts(tmp_path)) == (1, number)
    assert printed.endswith("Ray ended with 1\n")


def test_a_node_that_slurm_ends_between_two_attempts_starts_no_ray(tmp_path: Path) -> None:
    node = job._Node(Allocation.here(ENVIRONMENT | {"SLURM_NODEID": "0"}), "127.0.0.1")
    program = tmp_path / "ray"
    program.write_text("#!/bin/sh\nexec sleep 60\n")
    program.chmod(0o755)
    handler_before = signal.getsignal(signal.SIGTERM)
    with (
        pytest.MonkeyPatch.context() as patch,
        node.ended_by_slurm(),
    ):
        patch.setenv("PATH", f"{tmp_path}:{os.environ['PATH']}")
        signal.raise_signal(signal.SIGTERM)
        status, has_started = node.run_ray()
    assert (status, has_started) == (-signal.SIGTERM, False)
    assert signal.getsignal(signal.SIGTERM) is handler_before
