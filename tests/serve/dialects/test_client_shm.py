"""Clients' shared memory: read by name, and left alone."""

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Iterator
from multiprocessing.shared_memory import SharedMemory as Segment
from pathlib import Path

import pytest
from process_resources import descriptors

from vlagents_ray.errors import InvalidObservation
from vlagents_ray.serve.dialects.vlagents import SharedMemory


@pytest.fixture(name="segment")
def clients_segment() -> Iterator[Segment]:
    segment = Segment(create=True, size=4096)
    segment.buf[:5] = b"hello"
    yield segment
    segment.close()
    segment.unlink()


def test_what_the_client_wrote_is_read_each_time_anew(segment: Segment) -> None:
    memory = SharedMemory(same_machine=True)
    assert memory.read(segment.name, 5) == b"hello"
    segment.buf[:5] = b"world"
    assert memory.read(segment.name, 5) == b"world"
    memory.close()


def test_a_readers_end_leaves_the_segment_to_its_client(segment: Segment) -> None:
    """Also that of its whole process, whose resource tracker must not have heard of it."""
    code = (
        "import sys\nfrom vlagents_ray.serve.dialects.vlagents import SharedMemory\n"
        "print(SharedMemory(same_machine=True).read(sys.argv[1], 5).decode())"
    )
    done = subprocess.run(
        [sys.executable, "-c", code, segment.name], capture_output=True, text=True, check=True, timeout=60
    )
    assert (done.stdout, done.stderr) == ("hello\n", "")
    assert Path("/dev/shm", segment.name).exists()
    assert bytes(segment.buf[:5]) == b"hello"


def test_a_segment_that_shrinks_is_an_error_and_no_crash(segment: Segment) -> None:
    memory = SharedMemory(same_machine=True)
    assert len(memory.read(segment.name, 4096)) == 4096
    os.truncate(f"/dev/shm/{segment.name}", 0)
    with pytest.raises(InvalidObservation, match="shorter"):
        memory.read(segment.name, 4096)
    os.truncate(f"/dev/shm/{segment.name}", 4096)
    memory.close()


@pytest.mark.parametrize(
    "name", ["../../etc/passwd", "psm_../x", "/etc/passwd", "", "plasma_123", "psm_", "psm_0123\n", "psm_00000000"]
)
def test_only_segments_of_clients_can_be_named(name: str) -> None:
    with pytest.raises(InvalidObservation):
        SharedMemory(same_machine=True).read(name, 1)


def test_a_link_to_another_file_is_not_followed(tmp_path: Path) -> None:
    secret = tmp_path / "secret"
    secret.write_text("secret")
    link = Path("/dev/shm") / f"psm_{os.getpid():x}abc"
    link.symlink_to(secret)
    try:
        with pytest.raises(InvalidObservation):
            SharedMemory(same_machine=True).read(link.name, 6)
    finally:
        link.unlink()


def test_a_client_on_another_machine_names_none(segment: Segment) -> None:
    with pytest.raises(InvalidObservation, match="not on the server's machine"):
        SharedMemory(same_machine=False).read(segment.name, 5)


@pytest.mark.own_process
def test_descriptors_do_not_pile_up(segment: Segment) -> None:
    memory = SharedMemory(same_machine=True)
    segments = [Segment(create=True, size=64) for _ in range(80)]
    try:
        before = descriptors()
        for one in segments:
            memory.read(one.name, 1)
        assert len(descriptors() - before) <= 64
        memory.close()
        assert not descriptors() - before
    finally:
        for one in segments:
            one.close()
            one.unlink()
