"""Two replicas on one GPU, each with half of its memory: their kernels alternate, or run at the
same time with NVIDIA's Multi-Process Service (MPS).
"""

from __future__ import annotations

import contextlib
import os
import shutil
import subprocess
import tempfile
from collections.abc import Iterator, Mapping, Sequence
from typing import Any

from benchmarks.gpu.lab import Lab, view
from benchmarks.gpu.piped_processes import piped_processes
from vlagents_ray.policies.base.accelerator import GPU_SHARE, is_out_of_memory
from vlagents_ray.registry import require
from vlagents_ray.serve.python_env.child_start import die_with_parent

SHARE = 0.5
_OVER = 0.6  # share of the memory that a replica with half of it must not be able to allocate
_MPS = "nvidia-cuda-mps-control"
_PIPES, _LOGS = "CUDA_MPS_PIPE_DIRECTORY", "CUDA_MPS_LOG_DIRECTORY"


def sharing(lab: Lab) -> None:
    """Measure the actions per second of one replica, of two, and of two with MPS; and check their
    memory limit.
    """
    rows: list[dict[str, Any]] = []
    with _replicas(lab, 1) as replicas:
        rows.append({"replicas": "1", **_together(lab, replicas)})
    with _replicas(lab, 2) as replicas:
        rows.append({"replicas": "2", **_together(lab, replicas)})
        limited = [_ask(replica, "limit") for replica in replicas]
    lab.show(shared=rows)
    lab.check("replicas that are kept to their share of the memory", limited, equal=[True, True])

    control = shutil.which(_MPS)
    if control is None or lab.dry:
        lab.show(mps=f"not measured: {'a dry run' if lab.dry else f'no {_MPS}'}")
        return
    try:
        with _mps(control) as variables, _replicas(lab, 2, variables) as replicas:
            rows.append({"replicas": "2, MPS", **_together(lab, replicas)})
    except (subprocess.CalledProcessError, EOFError) as error:
        # The service, or one of its clients, ended, as a container may not permit MPS.
        lab.show(mps=f"failed: {type(error).__name__} {error}")
        return
    lab.show(shared=rows)
    two, with_mps = (row["actions_per_s"] for row in rows[-2:])
    lab.check("actions a second with MPS, of those without", with_mps / two, least=1.0, speed=True)


@contextlib.contextmanager
def _mps(control: str) -> Iterator[dict[str, str]]:
    """Run the MPS of this user within a context, and yield the environment variables of its
    clients.
    """
    with tempfile.TemporaryDirectory() as folder:
        variables = {_PIPES: f"{folder}/pipe", _LOGS: f"{folder}/log"}
        for path in variables.values():
            os.mkdir(path)
        environment = {**os.environ, **variables}
        subprocess.run([control, "-d"], env=environment, check=True)
        try:
            yield variables
        finally:
            subprocess.run([control], input="quit\n", env=environment, text=True, check=False)


@contextlib.contextmanager
def _replicas(
    lab: Lab, count: int, variables: Mapping[str, str] | None = None
) -> Iterator[list[Any]]:
    """Run processes with π0 within a context, and yield the pipes to them."""
    size = lab.size(8, 2)
    config = lab.settings(max_rows=size, compile=lab.size("graphs", False), batch_sizes=[1, size])
    environment = {**(variables or {}), GPU_SHARE: str(SHARE)}
    with piped_processes(_serve, [(config, size, environment)] * count) as pipes:
        yield pipes


def _ask(pipe: Any, question: str, *arguments: Any) -> Any:
    pipe.send((question, *arguments))
    return pipe.recv()


def _together(lab: Lab, pipes: Sequence[Any]) -> dict[str, float]:
    """Measure all replicas at the same time; return the sum of their rates, and the mean duration
    of their batches, ms.
    """
    for pipe in pipes:
        pipe.send(("measure", lab.size(3.0, 0.05)))
    turns = [pipe.recv() for pipe in pipes]
    return {
        "actions_per_s": sum(turn["actions_per_s"] for turn in turns),
        "batch_ms": sum(turn["batch_ms"] for turn in turns) / len(turns),
    }


def _serve(pipe: Any, config: dict[str, Any], size: int, environment: Mapping[str, str]) -> None:
    """Load π0, and answer requests until the pipe is closed; runs in a separate process."""
    die_with_parent()
    os.environ |= environment
    from benchmarks.measured_policy import MeasuredPolicy
    from vlagents_ray.policies.wrapper import build_agent

    agent = build_agent("pi0", config)
    with MeasuredPolicy(agent, view, max_size=size, patience=0.1) as measured:
        pipe.send("loaded")
        with contextlib.suppress(EOFError):
            while True:
                question, *arguments = pipe.recv()
                if question == "limit":
                    pipe.send(_is_limited(config["device"]))
                    continue
                turn = measured.queued(size, arguments[0], "robot")
                batch_ms = 1e3 * size / max(turn.actions_per_s, 1e-9)
                pipe.send({"actions_per_s": turn.actions_per_s, "batch_ms": batch_ms})


def _is_limited(device: str) -> bool:
    """Return whether this process cannot allocate more than its share; true without a GPU."""
    torch = require("torch")
    if device == "cpu":
        return True
    total = torch.cuda.mem_get_info()[1]
    try:
        torch.empty(int(_OVER * total), dtype=torch.uint8, device=device)
    except RuntimeError as error:
        return is_out_of_memory(error)
    return False
