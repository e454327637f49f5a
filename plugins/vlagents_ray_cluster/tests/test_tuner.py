"""Tests of variants of a policy, which are measured in separate processes."""

from __future__ import annotations

import time
from pathlib import Path
from typing import Any

import pytest
from tuned_recordings import record

from vlagents_ray.errors import ConfigError
from vlagents_ray.serve.config.deployment import ServerArgs
from vlagents_ray_cluster.tune.tuner import TunePlan, Tuner, TuningGoal, VariantFailed, choose

pytestmark = pytest.mark.slow  # each variant is measured in a separate process

SUPPORT = str(Path(__file__).parent / "support")


@pytest.fixture(autouse=True)
def importable(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("PYTHONPATH", SUPPORT)


def tuner(policy: str = "Tunable", *, batch: dict[str, Any] | None = None, **options: Any) -> Tuner:
    """Return a quick tuner; options are fields of the plan, or otherwise settings of the policy."""
    plan: dict[str, Any] = {"goal": TuningGoal("throughput"), "max_batch": 2, "seconds": 0.1}
    config = {}
    for name, value in options.items():
        if name in TunePlan.__dataclass_fields__:
            plan[name] = value
        else:
            config[name] = value

    args = ServerArgs(
        policy=f"tuned_policies:{policy}", config=config, batch=batch or {"max_size": 2}
    )
    return Tuner(TunePlan(args=args, **plan))


def test_compilation_that_helps_is_chosen() -> None:
    measured = tuner()
    points = measured.measure()
    chosen = choose(points, TuningGoal("throughput"))
    assert chosen.variant.changes == {"compile": True, "batch_sizes": [1, 2]}
    assert chosen.difference == 0
    assert {point.variant.name for point in points} == {"own settings", "compile: true"}
    assert {point.sessions for point in points if not point.variant.changes} == {1, 2}
    assert all(0 < point.round_trip_ms <= point.p99_ms for point in points)
    assert measured.left_out == []
    assert measured.device == "cpu"


def test_the_largest_batch_of_the_file_is_measured_and_only_useful_sizes_are_compiled() -> None:
    points = tuner(batch={"max_size": 3}, row_ms=20.0, eager_ms=0.0).measure()
    unchanged = [point for point in points if not point.variant.changes]
    assert [point.sessions for point in unchanged] == [1, 2, 3]

    best = max(unchanged, key=lambda point: point.actions_per_s).sessions
    changed = [point for point in points if point.variant.changes]
    compiled_sizes = {tuple(point.variant.changes["batch_sizes"]) for point in changed}
    assert compiled_sizes == {(1, 2, 3)[:best]}


def test_a_type_whose_actions_differ_is_refused_and_one_whose_process_ends_is_left_out() -> None:
    measured = tuner(dtypes=["bfloat16", "float16", "auto"], off=5.0, compile=True)
    assert {point.variant.name for point in measured.measure()} == {"own settings"}
    refused, crashed = measured.left_out
    assert refused.startswith("dtype: bfloat16: rejected, as actions differ by")
    assert crashed == "dtype: float16: ended with exit status 7"


@pytest.mark.parametrize("name", ["bfloat16", "int8"])
def test_a_type_whose_actions_are_near_enough_passes(name: str) -> None:
    measured = tuner(dtypes=[name], off=5.0, compile=True, tolerance=10.0)
    changed = [point for point in measured.measure() if point.variant.changes]
    [variant] = {point.variant.name: point.variant for point in changed}.values()
    [difference] = {point.difference for point in changed}
    assert variant.changes == {"quantization" if name == "int8" else "dtype": name}
    assert difference > 0.01
    assert measured.left_out == []


def test_a_batch_without_memory_ends_the_sizes_and_smaller_ones_stay() -> None:
    measured = tuner(compile=True, most_rows=2, max_batch=4, goal=TuningGoal("robots", 60_000.0))
    assert [point.sessions for point in measured.measure()] == [1, 2]
    assert measured.left_out == ["own settings, 4 sessions: MemoryError: 4 rows"]


def test_what_is_not_done_in_time_is_left_out() -> None:
    args = ServerArgs(policy="tuned_policies:Tunable")
    late = Tuner(TunePlan(args, TuningGoal("throughput"), minutes=2), began=time.monotonic() - 120)
    with pytest.raises(
        VariantFailed, match="own settings: not done within 2 minutes; raise --minutes"
    ):
        late.measure()


def test_variants_that_cannot_be_loaded_leave_the_file_as_it_is() -> None:
    measured = tuner(compiles=False, dtypes=["bfloat16"])
    names = [point.variant.name for point in measured.measure()]
    assert set(names) == {"own settings", "dtype: bfloat16"}
    # Variants with both changes are not measured either.
    assert measured.left_out == ["compile: true: ConfigError: compile: this one has no compiler"]


def test_a_policy_that_is_random_in_itself_cannot_be_compared() -> None:
    with pytest.raises(VariantFailed, match="same observations and seeds"):
        tuner("Unseeded").measure()


def test_recorded_observations_are_acted_on_if_they_fit(tmp_path: Path) -> None:
    record(tmp_path / "ep0.npz", 1.0, part="joints")
    assert {point.variant.name for point in tuner(frames=tmp_path, compile=True).measure()} == {
        "own settings"
    }
    record(tmp_path / "ep0.npz", 1.0)
    with pytest.raises(VariantFailed, match=r"own settings: .*joints"):
        tuner(frames=tmp_path).measure()


def test_a_policy_without_such_settings_gets_a_batch_size() -> None:
    args = ServerArgs(policy="tuned_policies:Plain", batch={"max_size": 2})
    plan = TunePlan(args, TuningGoal("throughput"), max_batch=2, seconds=0.1)
    assert {point.variant.name for point in Tuner(plan).measure()} == {"own settings"}
    with pytest.raises(ConfigError, match="expected a policy with the setting `dtype`"):
        Tuner(TunePlan(args, TuningGoal("throughput"), dtypes=["bfloat16"])).measure()


def test_fixed_sizes_of_the_file_are_those_that_are_measured() -> None:
    measured = tuner(
        batch={"sizes": [2, 3]}, compile=True, max_batch=3, goal=TuningGoal("robots", 60_000.0)
    )
    assert [point.sessions for point in measured.measure()] == [2, 3]
    with pytest.raises(
        ConfigError, match="--max-batch: expected at least 2, the file's smallest fixed size, got 1"
    ):
        tuner(batch={"sizes": [2, 3]}, max_batch=1).measure()


@pytest.mark.parametrize(
    ("file_mode", "modes", "tried"),
    [
        (False, [False, True], [True]),
        ("graphs", [False, "graphs", True], [False, True]),
        (False, [False, "graphs", True], ["graphs", True]),
        (True, [False, "graphs", True], []),
        ("require", [False, True], []),
    ],
)
def test_other_modes_of_compilation_are_tried_unless_the_file_compiles(
    file_mode: Any, modes: list[Any], tried: list[Any]
) -> None:
    sizes = [1, 2, 4, 8] if file_mode else None  # the default
    settings = {"compile": file_mode, "batch_sizes": sizes}
    ready = {"settings": settings, "dtypes": [], "modes": modes}

    expected = []
    for mode in tried:
        expected.append({"compile": mode, "batch_sizes": [1, 2]} if mode else {"compile": mode})
    assert [variant.changes for variant in tuner()._variants(ready, [1, 2])] == expected
