"""An answer of a hostile server takes little memory on a robot's computer; tests/clients tests the
other languages.
"""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

from hostile_messages import ADDED_MB, ANSWERS

READ = """
import resource, sys
from contextlib import suppress
from pathlib import Path
from vlagents_ray.errors import VLAgentsError
from vlagents_ray.protocol.frames import decode_replies
from vlagents_ray.validation import check_action

def peak_mb():
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1000

before = peak_mb()
for file in Path(sys.argv[1]).iterdir():
    with suppress(VLAgentsError):
        [reply] = decode_replies(file.read_bytes())
        if reply.act is not None:
            check_action(reply.act.action, None)
print(peak_mb() - before)
"""


def test_no_answer_fills_the_memory_of_a_robots_computer(tmp_path: Path) -> None:
    for number, answer in enumerate(ANSWERS.values()):
        (tmp_path / f"{number}").write_bytes(answer)
    done = subprocess.run(
        [sys.executable, "-c", READ, tmp_path], check=False, capture_output=True, text=True
    )
    assert float(done.stdout) < ADDED_MB, done.stderr
