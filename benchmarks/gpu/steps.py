"""The steps. Each runs in a separate process, and writes figures and criteria to a `Lab`."""

from __future__ import annotations

import contextlib
import importlib.util
import json
import multiprocessing
import os
import shutil
import subprocess
import sys
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.checkpoints.recipes import FAMILIES, write_checkpoint
from benchmarks.gpu.child import child
from benchmarks.gpu.cold_start import cold_start, cold_starts
from benchmarks.gpu.lab import (
    INSTRUCTION,
    LATE_S,
    PUBLISHED,
    Acting,
    Lab,
    Session,
    Step,
    row_error,
    seconds_of,
    view,
)
from benchmarks.gpu.number_formats import number_formats
from benchmarks.gpu.robots import served
from benchmarks.gpu.samples import GpuSamples
from benchmarks.gpu.sharing import sharing
from benchmarks.measured_policy import MeasuredPolicy, forget_peak, peak_mib
from benchmarks.network import profile, waits
from vlagents_ray.errors import MissingDependency, VLAgentsError
from vlagents_ray.interface import BEHAVIOUR, DELAY, DISTRIBUTION, LEFTOVER, SAMPLES, WANT, Agent
from vlagents_ray.policies.compilation import TOLERANCE
from vlagents_ray.policies.wrapper import build_agent
from vlagents_ray.registry import require
from vlagents_ray.serve.engine.engine import Engine
from vlagents_ray.serve.python_env.child_start import die_with_parent
from vlagents_ray.serve.weights import PushOptions, Rest

ROOT = Path(__file__).resolve().parents[2]
GPU_TESTS = (
    "tests/policies/compilation/test_cuda_graph.py",
    "plugins/vlagents_ray_learn/tests/test_one_gpu.py",
)  # tests that need no Ray
# Minimum rate of matrix products in bfloat16. About 800 were measured; a lower rate shows another
# problem.
_H100_TFLOPS = 600
GRAPH_ROWS = (1, 2, 4, 8, 16, 32)  # batch sizes with CUDA graphs
WORDS = 200  # number of tokens in an instruction of π0.5
_MOST_PLACES = 8  # number of rows in the batches that are examined
PUSHES = 20  # number of pushes of a learner that allocates new tensors for each push


def facts(lab: Lab) -> None:
    """Device, versions, and the speed of matrix products and of copies."""
    torch = require("torch")
    lab.check("a GPU computes", lab.dry or torch.cuda.is_available(), equal=True)
    program = shutil.which("nvidia-smi")
    said = program and subprocess.run(
        [program, "--query-gpu=name,driver_version,memory.total", "--format=csv,noheader"],
        capture_output=True, text=True, check=False,
    ).stdout.strip()  # fmt: skip
    lab.show(
        gpu=said or "none",
        torch=torch.__version__,
        cuda=torch.version.cuda,
        cores=os.cpu_count(),
        triton=importlib.util.find_spec("triton") is not None,
        compiler=shutil.which("gcc") or shutil.which("cc"),
        cudnn=None if lab.dry else torch.backends.cudnn.version(),
    )
    side, count = lab.size(8192, 256), lab.size(2**28, 2**20)
    a = torch.randn(side, side, device=lab.device, dtype=torch.bfloat16)
    tflops = 2 * side**3 / seconds_of(lab, lambda: a @ a) / 1e12
    here, pinned = (
        torch.empty(count, dtype=torch.uint8),
        torch.empty(count, dtype=torch.uint8, pin_memory=not lab.dry),
    )
    there = torch.empty(count, dtype=torch.uint8, device=lab.device)
    copies = {
        "on the device": (there.clone(), there),
        "to the device": (there, here),
        "from the device": (here, there),
        "to the device, pinned": (there, pinned),
        "from the device, pinned": (pinned, there),
    }
    rates = {
        name: count / seconds_of(lab, partial(a.copy_, b)) / 1e9 for name, (a, b) in copies.items()
    }
    lab.show(
        bf16_tflops=tflops,
        copies=[{"copy": name, "gb_per_s": rate} for name, rate in rates.items()],
    )
    if "H100" in str(said) or "H200" in str(said):
        lab.check("matrix products in bfloat16, TFLOP/s", tflops, least=_H100_TFLOPS, speed=True)


def gpu_tests(lab: Lab) -> None:
    """Run the tests that need a GPU but no Ray."""
    words = ["--collect-only"] if lab.dry else ["--tb=short"]
    done = subprocess.run(
        [
            sys.executable,
            "-m",
            "pytest",
            *GPU_TESTS,
            "-m",
            "gpu",
            "-q",
            "--import-mode=importlib",
            "-W",
            "default",
            "-p",
            "no:cacheprovider",
            *words,
        ],
        cwd=ROOT,
        capture_output=True,
        text=True,
        check=False,
    )
    sys.stdout.write(done.stdout + done.stderr)
    lab.show(pytest=(done.stdout.strip().splitlines() or ["nothing"])[-1])
    lab.check("pytest's exit status", done.returncode, equal=0)


def checkpoint(lab: Lab) -> None:
    """Write random checkpoints of π0, and of π0.5 if LeRobot is installed, in their true sizes."""
    for family in ("pi0", "pi05"):
        begun, folder = time.perf_counter(), lab.plan.scratch / family
        try:
            made = write_checkpoint(family, folder, lab.size("full", "small"))
        except MissingDependency as error:
            lab.show(**{family: f"not installed: {str(error).partition(';')[0]}"})
            continue
        (lab.plan.scratch / f"{family}.json").write_text(json.dumps(made.config))
        lab.show(
            **{family: f"{made.parameters:,} parameters in {time.perf_counter() - begun:.1f} s"}
        )
        if family == "pi0":
            lab.check(
                "parameters of π0, billions", round(made.parameters / 1e9, 2), equal=3.5, speed=True
            )


def curve(lab: Lab, measured: MeasuredPolicy, sizes: Sequence[int]) -> list[dict[str, Any]]:
    """Measure the network alone, the bare policy and the policy behind its queue, by batch size."""
    rows, seconds = [], lab.size(1.0, 0.02)
    for size in sizes:
        forget_peak()
        with GpuSamples() as samples:
            bare = measured.bare(size, seconds)
            samples.forget()
            queued = measured.queued(size, seconds, "robot")
        rows.append(
            {
                "rows": size,
                "network_ms": bare["network_ms"],
                "bare_ms": bare["batch_ms"],
                "queued_ms": 1e3 * size / max(queued.actions_per_s, 1e-9),
                "actions_per_s": queued.actions_per_s,
                "mean_batch": queued.mean_batch,
                "peak_mib": peak_mib(),
                "of_network": queued.actions_per_s * bare["network_ms"] / 1e3 / size,
                **samples.figures(queued.actions_per_s),
            }
        )
        lab.show(curve=rows)
    return rows


def one_act(
    lab: Lab, measured: MeasuredPolicy, sizes: Sequence[int], rows: Sequence[Mapping[str, Any]]
) -> None:
    """Profile one call of each batch size: launches, the busy time and the gaps of the GPU, waits
    for the GPU, and the longest kernels of each core.
    """
    looked = []
    for size in sizes:
        batch = measured.batch(range(size))
        found = profile(batch)
        bare_ms = next(row["bare_ms"] for row in rows if row["rows"] == size)
        looked.append({"rows": size, **found, "busy_share": found["busy_ms"] / bare_ms})
        for core, kernels in measured.kernels(size).items():
            lab.show(**{f"kernels of {core}, {size} rows": kernels})
    places = waits(batch)
    lab.show(acts=looked, waits=[f"{count} at {place}" for place, count in places.most_common(20)])
    lab.check("waits of the CPU in an act; one is for the result", sum(places.values()), most=1)


def neighbours(lab: Lab, measured: MeasuredPolicy, size: int) -> float:
    """Compare the actions of one episode: at each place of a full batch with different neighbours,
    and in a batch of its own.

    At one place the same kernels compute a row, so its neighbours change no bit; alone, other
    kernels round differently.

    Returns:
        The largest error of an action in a batch, relative to the action that is computed alone.
    """
    alone, changed, errors = measured.batch([0])()[0].action, 0, []
    for place in range(size):
        acts = []
        for first in (1, 1 + size):
            others = list(range(first, first + size - 1))
            acts.append(measured.batch([*others[:place], 0, *others[place:]])()[place].action)
        changed += not np.array_equal(acts[0], acts[1])
        errors.append(row_error(acts[0], alone))
    lab.show(error_of_an_act_in_a_batch=max(errors))
    lab.check(f"places of {size} at which neighbours change an act", changed, equal=0)
    return max(errors)


def speed(lab: Lab, mode: bool | str) -> None:
    """Load π0, eager or compiled; measure it by batch size, and compare its actions with eager
    actions.
    """
    rows_of_mode = {False: (1, 8), True: lab.plan.rows, "graphs": GRAPH_ROWS}
    sizes = lab.size([*rows_of_mode[mode]], [1, 2])
    how = lab.graphs if mode == "graphs" else mode
    begun = time.perf_counter()
    config = lab.settings(
        max_rows=sizes[-1], compile=how, **({"batch_sizes": sizes} if mode else {})
    )
    with contextlib.ExitStack() as loaded:
        with lab.lines_of("policy", "start"):
            measured = loaded.enter_context(lab.measured(config=config, largest=sizes[-1]))
        if mode is True:
            measured.batch([0])()
            took_s = time.perf_counter() - begun
            name = f"compiled, {len(sizes)} sizes"
            lab.show(starts=[{"mode": name, "seconds": took_s, "load_s": measured.load_s}])
        memory = {} if lab.dry else require("torch").cuda.memory_stats()
        held = {
            kind: memory.get(f"{kind}_bytes.all.current", 0) / 2**20
            for kind in ("allocated", "reserved")
        }
        lab.show(load_s=measured.load_s, **{f"{kind}_mib": value for kind, value in held.items()})
        lab.check("parts that are not compiled", measured.engine.model.uncompiled, equal=[])
        rows = curve(lab, measured, sizes)
        acts = {f"rows_{size}": np.stack(measured.actions(size, size)) for size in sizes}
        looked_at = [size for size in sizes if size <= _MOST_PLACES]
        rounded = neighbours(lab, measured, looked_at[-1])
        one_act(lab, measured, [looked_at[0], looked_at[-1]], rows)
    share = next(row["of_network"] for row in rows if row["rows"] == sizes[-1])
    lab.check(
        f"queued, as a share of the network alone, {sizes[-1]} rows", share, least=0.95, speed=True
    )
    file = lab.plan.scratch / "eager.npz"
    if not mode:
        np.savez(file, **{**acts, "rounded": np.array(rounded), "ms": np.array(rows[0]["bare_ms"])})  # type: ignore[arg-type]
    if not mode or not file.is_file():
        return
    eager = np.load(file)
    lab.show(
        bit_equal_to_eager=all(
            np.array_equal(found, eager[name]) for name, found in acts.items() if name in eager
        )
    )
    errors = [row_error(found, eager[name]) for name, found in acts.items() if name in eager]
    # The tolerance of bfloat16, or the error that another batch size causes, if it is larger.
    limit = max(TOLERANCE["bfloat16"], float(eager["rounded"]))
    lab.check("error of compiled acts of other inputs", max(errors), most=limit)
    lab.check(
        "eager time over compiled time, one row",
        eager["ms"] / rows[0]["bare_ms"],
        least=2,
        speed=True,
    )


def words(lab: Lab) -> None:
    """Measure π0 with 200 words, which are as many tokens as in π0.5."""
    sizes = lab.size([1, 2, 4, 8], [1, 2])
    config = lab.settings(
        max_tokens=WORDS, max_rows=sizes[-1], compile=lab.graphs, batch_sizes=sizes
    )
    with lab.measured(config=config, largest=sizes[-1]) as measured:
        curve(lab, measured, sizes)
        if not lab.dry:
            for core, kernels in measured.kernels(1).items():
                lab.show(**{f"kernels of {core}, 1 row": kernels})
    lab.show(published=PUBLISHED)


def again(lab: Lab) -> None:
    """Start a process with the compiled π0, whose compiled programs are stored."""
    sizes = lab.size([*lab.plan.rows], [1, 2])
    if lab.dry:  # another process would use the compiler itself
        lab.show(starts="not measured: a dry run")
        return
    config = lab.settings(max_rows=sizes[-1], compile=True, batch_sizes=sizes)
    start = cold_start("compiled, kept", config)
    lab.show(starts=[start])
    lab.check("seconds until it acts, with kept programs", start["seconds"], most=60, speed=True)


def pushes(lab: Lab) -> None:
    """Push weights of the model's size to acting sessions: from this process, through the CPU,
    from another process.
    """
    from vlagents_ray.weights.trainable import own_copy
    from vlagents_ray_learn.publisher import Publisher

    torch = require("torch")
    with lab.engine() as engine:
        agent: Any = engine.model.own_weights._trainable
        live = agent.parameters()
        first = {name: own_copy(value) for name, value in live.items()}
        model_mib = sum(value.nbytes for value in first.values()) / 2**20
        robots = [Session(engine, seed, weights="follow") for seed in range(lab.size(8, 2))]
        fixed = Session(engine, 50, weights="follow")

        def act() -> np.ndarray:
            fixed.ask("reset", instruction=INSTRUCTION, kwargs={"seed": 50, "weights": "follow"})
            return np.asarray(fixed.ask().act.action)  # type: ignore[union-attr]

        threads = ("asyncio_", "MainThread")  # names of the threads on which values are staged

        def pushed(way: str, push: Callable[[], object]) -> None:
            forget_peak()
            with (
                Acting([robot.ask for robot in robots]) as acting,
                lab.lines_of(threads, f"push from {way}"),
            ):
                found = acting.during(push, 2 * len(robots))
            reserved = {} if lab.dry else {"reserved_mib": torch.cuda.memory_reserved() / 2**20}
            # Both are computed alone, as batches of other sizes round differently.
            changed = not np.array_equal(act(), before)
            rows.append(
                {"from": way, **found, "peak_mib": peak_mib(), **reserved, "changed": changed}
            )
            lab.show(model_mib=model_mib, pushes=rows)

        take = partial(take_push, lab, engine)
        before, rows, publisher = act(), list[dict[str, Any]](), Publisher(engine)
        on_cpu = {name: value.cpu() * 1.01 for name, value in first.items()}
        pushed("no push", lambda: time.sleep(lab.size(1, 0)))
        pushed("the CPU", lambda: publisher.push(on_cpu, mode="keep"))
        with other_learner(lab, _shapes_of(first)) as values:
            # The loaded checkpoint moves to the host.
            pushed("another process", lambda: take(values, 9))
            pushed("another process, again", lambda: take(values, 10))
        pushed("this process, the first ones", lambda: publisher.push(first, mode="keep"))
        held = temporary_pushes(lab, first, lambda values, number: take(values, 20 + number))
        lab.show(learner=held)
        lab.check(
            f"the learner's memory after {PUSHES} pushes, as after the first",
            held["after_mib"] / max(held["after_one_mib"], 1e-9) if held["after_mib"] else 1.0,
            most=1.05,
            speed=True,
        )
        lab.check("failed acts", sum(row["failed"] for row in rows), equal=0)
        lab.check(
            "the acts change with the weights",
            [row["changed"] for row in rows],
            equal=[False, True, True, True, False],
        )
        lab.check(
            "seconds of a push from another process", rows[3]["seconds"], most=0.3, speed=True
        )
        # Without this step's copy of the first weights.
        held = max(row["peak_mib"] for row in rows) - model_mib
        lab.check("peak memory, times the model", held / model_mib, most=3.2, speed=True)


def take_push(lab: Lab, engine: Engine, values: Any, version: int) -> None:
    """Use values that another process shares as the weights of all sessions that follow the newest
    weights.
    """
    options = PushOptions("keep", allow_same=True)
    engine.weights.stage(version, values.others if lab.dry else values, options)
    engine.weights.commit(version, options)


def temporary_pushes(
    lab: Lab, like: Mapping[str, Any], take: Callable[[Any, int], None]
) -> dict[str, float]:
    """Apply pushes of a learner in another process that allocates new tensors for each push, as
    with gathered shards or merged adapters.

    Returns:
        The median time of a push, s, and the memory of the learner after the first push and after
        all pushes, MiB.
    """
    count = lab.size(PUSHES, 2)
    context = multiprocessing.get_context("spawn")
    ours, theirs = context.Pipe()
    args = (theirs, _shapes_of(like), lab.device, count)
    process = context.Process(target=_learn_again, args=args, daemon=True)
    process.start()
    theirs.close()
    taken_s, held_mib = [], []
    for number in range(count):
        values = ours.recv()
        begun = time.perf_counter()
        take(values, number)
        taken_s.append(time.perf_counter() - begun)
        del values
        ours.send(None)
        held_mib.append(ours.recv())
    process.join(LATE_S)
    return {
        "pushes": count,
        "median_s": float(np.median(taken_s)),
        "after_one_mib": held_mib[0],
        "after_mib": held_mib[-1],
    }


def _learn_again(pipe: Any, shapes: Mapping[str, Any], device: str, count: int) -> None:
    from vlagents_ray.weights.shared_values import shared

    die_with_parent()
    torch = require("torch")
    for number in range(count):
        values = _filled(shapes, 0.01 + 0.001 * number, device)
        with shared(values) as found:
            pipe.send(found)
            pipe.recv()  # arrives when the policy has copied the values
        del values, found
        reserved = torch.cuda.memory_allocated() if torch.cuda.is_initialized() else 0
        pipe.send(reserved / 2**20)


def _shapes_of(values: Mapping[str, Any]) -> dict[str, tuple[tuple[int, ...], str]]:
    """Return the shapes of tensors and the names of their types."""
    return {
        name: (tuple(value.shape), str(value.dtype).removeprefix("torch."))
        for name, value in values.items()
    }


def _filled(shapes: Mapping[str, Any], number: float, device: str) -> dict[str, Any]:
    """Return new tensors of these shapes and types."""
    torch = require("torch")
    return {
        name: torch.full(shape, number, dtype=getattr(torch, kind), device=device)
        for name, (shape, kind) in shapes.items()
    }


def sleep(lab: Lab) -> None:
    """Free the policy's memory for a learner, and restore it; measure the times, and the memory of
    the process.

    Finally a learner in another process uses the memory in between, and pushes its values when the
    policy has woken, as in an iteration of reinforcement learning.
    """
    torch = require("torch")

    def reserved_mib() -> float:
        return 0.0 if lab.dry else torch.cuda.memory_reserved() / 2**20

    with lab.engine() as engine:
        robot = Session(engine, 0, weights="follow")
        first_kwargs = {"seed": 0, "weights": "follow"}
        agent: Any = engine.model.own_weights._trainable
        shapes = _shapes_of(agent.parameters())

        def act() -> np.ndarray:
            robot.ask("reset", instruction=INSTRUCTION, kwargs=first_kwargs)
            return np.asarray(robot.ask().act.action)  # type: ignore[union-attr]

        before, rows = act(), list[dict[str, Any]]()
        for offload in (False, True):
            awake_mib = reserved_mib()
            begun = time.perf_counter()
            engine.weights.rest(Rest("sleep", offload=offload))
            asleep, asleep_mib = time.perf_counter(), reserved_mib()
            engine.weights.rest(Rest("wake"))
            woken = time.perf_counter()
            after = act()
            rows.append(
                {
                    "sleep": "offload" if offload else "cache alone",
                    "sleep_s": asleep - begun,
                    "wake_s": woken - asleep,
                    "first_act_s": time.perf_counter() - woken,
                    "awake_mib": awake_mib,
                    "asleep_mib": asleep_mib,
                    "same_act": bool(np.array_equal(before, after)),
                }
            )
            lab.show(sleep=rows)

        begun = time.perf_counter()
        engine.weights.rest(Rest("sleep", offload=True))
        asleep = time.perf_counter()
        with other_learner(lab, shapes) as values:
            learned = time.perf_counter()
            engine.weights.rest(Rest("wake"))
            woken = time.perf_counter()
            take_push(lab, engine, values, 1)
            pushed = time.perf_counter()
        rows.append(
            {
                "sleep": "offload, while a learner computes",
                "sleep_s": asleep - begun,
                "learner_s": learned - asleep,
                "wake_s": woken - learned,
                "push_s": pushed - woken,
                "same_act": bool(np.array_equal(before, act())),
            }
        )
        lab.show(sleep=rows)
    lab.check(
        "acts are the same after waking, and others after a push",
        [row["same_act"] for row in rows],
        equal=[True, True, False],
    )
    lab.check("memory while offloaded, MiB", rows[1]["asleep_mib"], most=1000, speed=True)


@contextlib.contextmanager
def other_learner(lab: Lab, shapes: Mapping[str, Any]) -> Iterator[Any]:
    """Yield values that another process shares, of these shapes and types, see `_shapes_of`."""
    context = multiprocessing.get_context("spawn")
    ours, theirs = context.Pipe()
    process = context.Process(target=_learn, args=(theirs, shapes, lab.device), daemon=True)
    process.start()
    theirs.close()
    yield ours.recv()
    ours.send(None)
    process.join(LATE_S)


def _learn(pipe: Any, shapes: Mapping[str, Any], device: str) -> None:
    from vlagents_ray.weights.shared_values import shared

    die_with_parent()
    values = _filled(shapes, 0.01, device)
    with shared(values) as found:
        pipe.send(found)
        pipe.recv()  # arrives when the policy has copied the values


def learning(lab: Lab) -> None:
    """Compare samples, continued plans and log-probabilities in bfloat16 with those that a float32
    learner computes.
    """
    from vlagents_ray.policies.flow import logprob_of_chain
    from vlagents_ray_models.pi0 import flow_velocity

    torch, count = require("torch"), lab.size(8, 2)
    server, learner = (
        build_agent("pi0", lab.settings(dtype=dtype, noise_level=0.5, max_rows=1 + count))
        for dtype in ("bfloat16", "float32")
    )
    for agent in (server, learner):
        agent.initialize()
    obs = view(server.contract, 0)
    learner.reset(obs, INSTRUCTION, seed=0)

    def timed(agent: Agent, **info: Any) -> tuple[Any, float]:
        agent.reset(obs, INSTRUCTION, seed=0)
        begun = time.perf_counter()
        act = agent.act(replace(obs, info=info))
        return act, (time.perf_counter() - begun) * 1e3

    timed(server)  # the first call also loads kernels
    plain, plain_ms = timed(server)
    sampled, sampled_ms = timed(server, **{SAMPLES: count})
    lab.show(act_ms=plain_ms, samples=count, samples_ms=sampled_ms)
    lab.check("samples", len(sampled.info[DISTRIBUTION]["samples"]), equal=count)
    plan = plain.action[2:]
    guided, guided_ms = timed(server, **{LEFTOVER: plan, DELAY: 2})
    lab.show(plan_ms=guided_ms)
    # Guidance leads to the plan, and does not replace rows with it.
    free_error, guided_error = (row_error(act.action[:2], plan[:2]) for act in (plain, guided))
    lab.check("guided rows' error, of the free ones'", guided_error / free_error, most=0.5)
    stated, stated_ms = timed(server, **{WANT: ["logprob", "replay"]})
    said, model = stated.info[BEHAVIOUR], learner.model  # type: ignore[attr-defined]
    inputs = learner._inputs(learner._rows(obs, learner))  # type: ignore[attr-defined]
    chain = torch.from_numpy(said["replay"]["chain"])[None].to(lab.device)
    with torch.no_grad():
        velocity = flow_velocity(model.network, inputs, torch.float32)
        again = logprob_of_chain(velocity, chain, said["replay"]["noise_level"])[
            0, :, : plain.action.shape[-1]
        ]
    off = again.float().cpu().numpy() - said["logprob"]
    lab.show(
        logprob_ms=stated_ms,
        log_ratio_std_of_a_number=float(off.std()),
        log_ratio_of_a_chunk=float(off.sum()),
    )
    lab.check("log-probabilities are finite", bool(np.isfinite(off).all()), equal=True)


def numerics(lab: Lab) -> None:
    """Measure TF32, and 8-bit formats."""
    torch, side = require("torch"), lab.size(4096, 64)
    a = torch.randn(side, side, device=lab.device)
    rows = []
    for precision in ("highest", "high"):
        torch.set_float32_matmul_precision(precision)
        error = float((a @ a - (a.double() @ a.double())).abs().max())
        rows.append(
            {
                "float32 products": precision,
                "tflops": 2 * side**3 / seconds_of(lab, lambda: a @ a) / 1e12,
                "largest_error": error,
            }
        )
    torch.set_float32_matmul_precision("highest")
    lab.show(products=rows)
    number_formats(lab)


def jax_beside(lab: Lab) -> None:
    """Measure the memory that JAX takes beside torch in one process."""
    torch = require("torch")
    if importlib.util.find_spec("jax") is None:
        lab.show(jax="not installed")
        return
    from vlagents_ray.policies.base.accelerator import jax_device

    total = 1 if lab.dry else torch.cuda.mem_get_info()[1]
    before = 0 if lab.dry else torch.cuda.mem_get_info()[0]
    device = jax_device(lab.size("auto", "cpu"))
    jax = require("jax")
    with jax.default_device(device):
        computed = float(jax.numpy.ones((64, 64)).sum())
    taken = 0 if lab.dry else before - torch.cuda.mem_get_info()[0]
    lab.show(jax=jax.__version__, device=str(device))
    lab.check("JAX computes", computed, equal=64 * 64)
    lab.check("share of the memory that JAX takes", taken / total, most=0.1, speed=True)


def families(lab: Lab) -> None:
    """Run other families whose packages are installed, with random weights."""
    rows = []
    for family in FAMILIES:
        if family in ("pi0", *lab.size([], ["openvla", "pi05"])):
            continue
        folder = lab.plan.scratch / f"family-{family}"
        try:
            made = write_checkpoint(family, folder, lab.size("full", "small"))
        except MissingDependency as error:
            lab.show(**{family: f"not installed: {str(error).partition(';')[0]}"})
            continue
        config = {**made.config, "device": lab.device, "max_rows": 8}
        config |= {"actions": "chunk"} if family == "diffusion" else {}
        with lab.measured(made.policy, config, largest=8) as measured:
            for size in lab.size((1, 8), (1,)):
                bare = measured.bare(size, lab.size(1.0, 0.02))
                rows.append({"family": family, "parameters": made.parameters, "rows": size, **bare,
                             "peak_mib": peak_mib()})  # fmt: skip
                lab.show(families=rows)
        shutil.rmtree(folder)
    lab.check("families that were measured act", len(rows), least=0)


def destruction(lab: Lab) -> None:
    """Exhaust the memory, then make the GPU fail: a single row can still be computed, and the
    health check reports the failure.
    """
    torch, largest = require("torch"), lab.size(16, 2)
    with lab.engine(compile=False, batch_sizes=None, max_rows=largest) as engine:
        agent: Any = engine.model.own_weights._trainable
        robots = [Session(engine, seed) for seed in range(largest)]
        run, hogs = agent.predict, []

        def full(rows: Sequence[Any]) -> Any:
            if lab.dry and len(rows) > 1:
                raise torch.OutOfMemoryError("CUDA out of memory")
            # 512 MiB remain: enough for one row, but not for the layers of sixteen rows.
            if not lab.dry:
                torch.cuda.empty_cache()
                free = max(0, torch.cuda.mem_get_info()[0] - 2**29)
                hogs.append(torch.empty(free, dtype=torch.uint8, device=lab.device))
            try:
                return run(rows)
            finally:
                hogs.clear()

        agent.predict = full
        with Acting([robot.ask for robot in robots]) as acting:
            found = acting.during(lambda: None, 3 * largest)
        lab.show(rows_that_fit=agent.most_rows, out_of_memory=[found])
        lab.check("failed acts, as fewer rows are tried again", found["failed"], equal=0)
        del agent.predict
        robots[0].ask()
        lab.check("one row acts after memory was exhausted", True, equal=True)
        engine.health.check()

        def broken(rows: Sequence[Any]) -> Any:
            if lab.dry:
                raise RuntimeError("CUDA error: device-side assert triggered")
            torch.zeros(1, device=lab.device)[torch.full((1,), 7, device=lab.device)]
            return run(rows)

        agent.predict = broken
        with contextlib.suppress(VLAgentsError):
            robots[0].ask()
        said = ""
        try:
            engine.health.check()
        except Exception as error:  # noqa: BLE001 - the health check may raise any error
            said = f"{type(error).__name__}: {error}"
        lab.show(health=said[:300])
        lab.check("the health check reports the failure", bool(said), equal=True)
        if not lab.dry:
            os._exit(0)  # nothing can be freed on a failed GPU


# All steps, with their time limits, s.
STEPS = {
    "facts": Step(facts, 20),
    "checkpoint": Step(checkpoint, 70, beside="tests"),
    "tests": Step(gpu_tests, 70),
    "eager": Step(partial(speed, mode=False), 30),
    "graphs": Step(partial(speed, mode="graphs"), 75),
    "words": Step(words, 40),
    "cold starts": Step(cold_starts, 45),
    "compiled": Step(partial(speed, mode=True), 135),
    "numerics": Step(numerics, 130),
    "compiled again": Step(again, 60),
    "served": Step(served, 50),
    "child": Step(child, 45),
    "sharing": Step(sharing, 65),
    "pushes": Step(pushes, 55),
    "sleep": Step(sleep, 25),
    "learning": Step(learning, 60),
    "jax": Step(jax_beside, 40),
    "families": Step(families, 90),
    "destruction": Step(destruction, 45),
}


@dataclass(frozen=True, slots=True)
class Run:
    """A run of steps whose limits fit into `SECONDS`, and of further steps if time is left."""

    steps: tuple[str, ...]
    extras: tuple[str, ...]


RUNS = {
    "acts": Run(
        ("facts", "checkpoint", "tests", "eager", "graphs", "words", "cold starts", "compiled"),
        ("numerics", "compiled again"),
    ),
    "serving": Run(
        ("checkpoint", "served", "child", "sharing", "pushes", "sleep"),
        ("destruction", "learning", "jax", "families"),
    ),
}
