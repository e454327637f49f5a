"""What a job makes of Slurm's variables."""

from __future__ import annotations

import os

import pytest

from vlagents_ray.slurm.job import Allocation, Ports

ENVIRONMENT = {"SLURM_JOB_ID": "4711", "SLURM_JOB_NUM_NODES": "3", "SLURM_NODEID": "1", "SLURM_CPUS_ON_NODE": "1"}


def options(**more: str) -> dict[str, str]:
    """Of `ray start`, by name."""
    words = Allocation.here(ENVIRONMENT | more).ray_start("10.0.0.5", "/tmp/x")
    assert words[:2] == ["ray", "start"]
    return dict(word.removeprefix("--").partition("=")[::2] for word in words[2:])


def test_ray_gets_what_slurm_gave_and_not_what_the_machine_has() -> None:
    found = options(SLURM_GPUS_ON_NODE="2", SLURM_MEM_PER_NODE="8192")
    assert (found["num-cpus"], found["num-gpus"]) == ("1", "2")
    assert int(found["memory"]) + int(found["object-store-memory"]) == 8192 * 2**20


def test_memory_may_be_counted_by_cpu_or_not_at_all() -> None:
    found = options(SLURM_MEM_PER_CPU="4096")
    assert int(found["memory"]) + int(found["object-store-memory"]) == 4096 * 2**20
    for more in ({}, {"SLURM_MEM_PER_NODE": "0"}):
        assert "memory" not in options(**more)


def test_a_task_that_is_bound_to_fewer_cpus_counts_those() -> None:
    assert Allocation.here(ENVIRONMENT | {"SLURM_CPUS_ON_NODE": "9999"}).cpus == len(os.sched_getaffinity(0))


def test_the_first_node_is_the_head_and_the_others_join_it() -> None:
    head, other = options(SLURM_NODEID="0"), options()
    assert {"head", "block"} <= head.keys()
    assert head["node-ip-address"] == "10.0.0.5"
    assert other["address"] == f"10.0.0.5:{head['port']}"
    assert "head" not in other


@pytest.mark.parametrize("job", [1, 4711, 2_499, 67_043_328])
def test_jobs_that_follow_each_other_share_no_port(job: int) -> None:
    def ports(number: int) -> Ports:
        return Allocation.here(ENVIRONMENT | {"SLURM_JOB_ID": str(number)}).ports

    def numbers(found: Ports) -> set[int]:
        return {found.gcs, found.client, found.metrics, found.serve}

    assert len(numbers(ports(job))) == 4
    assert not numbers(ports(job)) & numbers(ports(job + 1))
    assert all(10_000 <= port < 20_000 for port in numbers(ports(job)))


def test_rays_own_folder_which_it_opens_to_everybody_is_within_that_of_the_job() -> None:
    assert options()["temp-dir"] == "/tmp/x/ray"
