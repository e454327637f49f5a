"""The TypeScript client, tested by its own tests with golden files, a server with controlled
faults, and servers of this project.
"""

from __future__ import annotations

import json
import os
import subprocess
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
import typescript_client
from asgi_server import policy_server
from client_servers import client_servers
from hostile_messages import ADDED_MB, ANSWERS
from raptor import Raptor
from raptor_flights import TOLERANCE, observation, reference

pytestmark = pytest.mark.node


@pytest.fixture(scope="module")
def client() -> Path:
    return typescript_client.build()


@pytest.fixture(scope="module")
def servers() -> Iterator[dict[str, str]]:
    with client_servers() as urls:
        yield urls


def node(client: Path, *words: str, environment: dict[str, str] | None = None) -> str:
    """Run a script and return its output; raise an error with the whole output if it fails."""
    named = {name: value for name, value in os.environ.items() if name != "VLAGENTS_RAY_API_KEY"}
    done = subprocess.run(
        [str(typescript_client.NODE), *words],
        cwd=client,
        env=named | (environment or {}),
        capture_output=True,
        text=True,
        check=False,
        timeout=300,
    )
    assert done.returncode == 0, done.stdout + done.stderr
    return done.stdout


def passed(said: str) -> int:
    """Return the number of tests that passed; no test may be skipped."""
    counts = dict(
        line.removeprefix("# ").split(" ", 1) for line in said.splitlines() if line.startswith("# ")
    )
    assert [counts[word] for word in ("fail", "cancelled", "skipped", "todo")] == ["0"] * 4
    return int(counts["pass"])


def test_it_passes_its_tests_with_the_golden_files_and_with_servers_that_fail_or_are_real(
    client: Path, servers: dict[str, str]
) -> None:
    files = sorted(str(file.relative_to(client)) for file in (client / "test").glob("*.test.mjs"))
    assert (
        passed(
            node(
                client,
                "--test",
                "--test-reporter=tap",
                "--test-concurrency=4",
                *files,
                environment=servers,
            )
        )
        > 0
    )


def test_no_answer_fills_the_memory_of_a_robots_computer(client: Path, tmp_path: Path) -> None:
    for number, answer in enumerate(ANSWERS.values()):
        (tmp_path / f"{number}").write_bytes(answer)
    script = """
        import { readdirSync, readFileSync } from "node:fs";
        import { decodeReplies } from "vlagents-ray";
        const peak = () => process.resourceUsage().maxRSS / 1000;
        const [before, folder, outcomes] = [peak(), process.argv[1] + "/", {}];
        for (const file of readdirSync(folder)) {
          try { decodeReplies(new Uint8Array(readFileSync(folder + file))); outcomes[file] = "read"; }
          catch (error) { outcomes[file] = error.code; }
        }
        console.log(JSON.stringify([peak() - before, outcomes]));
    """
    added_mb, outcomes = json.loads(
        node(client, "--max-old-space-size=512", "--input-type=module", "-e", script, str(tmp_path))
    )
    assert added_mb < ADDED_MB
    assert len(outcomes) == len(ANSWERS)
    assert set(outcomes.values()) == {"read", "malformed"}


def test_it_carries_the_reference_of_a_recurrent_policy(client: Path, tmp_path: Path) -> None:
    inputs, wanted = reference()
    rows = [
        [{"state": {n: p.tolist() for n, p in observation(row).state.items()}} for row in pair]
        for pair in inputs
    ]
    (tmp_path / "observations").write_text(json.dumps(rows))
    script = """
        import { readFileSync } from "node:fs";
        import { RemoteAgent } from "vlagents-ray";
        const [url, file] = process.argv.slice(1);
        const rows = JSON.parse(readFileSync(file));
        const agents = [new RemoteAgent(url), new RemoteAgent(url)];
        for (const [i, agent] of agents.entries()) await agent.reset(rows[0][i]);
        const actions = [];
        for (const pair of rows) {
          const acts = await Promise.all(agents.map((agent, i) => agent.act(pair[i])));
          actions.push(acts.map(({ rows: [action] }) => Array.from(action)));
        }
        for (const agent of agents) await agent.close();
        console.log(JSON.stringify(actions));
    """
    with policy_server(Raptor()) as port:
        said = node(
            client,
            "--input-type=module",
            "-e",
            script,
            f"http://127.0.0.1:{port}",
            str(tmp_path / "observations"),
        )
    assert np.abs(np.array(json.loads(said)) - wanted).max() < TOLERANCE


def test_its_example_runs(client: Path, servers: dict[str, str]) -> None:
    said = node(client, "examples/loop.mjs", servers["VLAGENTS_TEST_URL"], "--ticks", "12")
    assert "12 ticks" in said


def test_the_package_has_what_its_users_need_and_nothing_else(client: Path) -> None:
    said = subprocess.run(
        [str(typescript_client.NPM), "pack", "--dry-run", "--ignore-scripts", "--json"],
        cwd=client,
        capture_output=True,
        text=True,
        check=True,
    ).stdout
    assert '"dist/index.js"' in said
    assert '"dist/index.d.ts"' in said
    assert '"README.md"' in said
    assert "test/" not in said
    assert "node_modules" not in said
