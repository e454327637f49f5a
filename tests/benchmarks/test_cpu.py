"""CPU time of other processes."""

from __future__ import annotations

import subprocess
import sys
import time

import pytest

from benchmarks.overhead import CpuSampler, cpu_seconds

BURN = "import sys, time\nwhile time.process_time() < 0.5: pass\nprint(flush=True)\nsys.stdin.read()"


def test_what_a_process_used_is_counted_and_stays_counted_when_it_has_ended() -> None:
    with subprocess.Popen([sys.executable, "-c", BURN], stdin=subprocess.PIPE, stdout=subprocess.PIPE) as burning:
        assert burning.stdout is not None
        assert burning.stdin is not None
        begun = time.time()
        with CpuSampler(lambda: [burning.pid]) as cpu:
            burning.stdout.readline()
            assert cpu_seconds(burning.pid) >= 0.4
            time.sleep(0.5)  # a sample or two
            burning.stdin.close()
            burning.wait()
            time.sleep(0.5)
        assert cpu.between(begun, time.time()) >= 0.3


def test_a_process_that_is_not_there_is_an_error() -> None:
    with pytest.raises(OSError, match="/proc"):
        cpu_seconds(2**22 + 1)
