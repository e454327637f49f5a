"""No family's safe or neutral action changes a target, for checkpoints with groups of all kinds."""

from __future__ import annotations

import itertools
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from vlagents_ray.chunking.fallback import SafeAction
from vlagents_ray.columns import Columns
from vlagents_ray.contract import ActionSpec, Contract
from vlagents_ray.evaluate.episode.latency import ChunkExecutor
from vlagents_ray.evaluate.plan.config import ClockConfig
from vlagents_ray.interface import Obs
from vlagents_ray_models import diffusion_policy, gr00t, octo, openpi

# Type, format and width of a group of GR00T.
KINDS = [
    ("NON_EEF", "DEFAULT", 1),
    ("NON_EEF", "DEFAULT", 7),
    ("EEF", "DEFAULT", 7),
    ("EEF", "XYZ_ROTVEC", 6),
    ("EEF", "XYZ_ROT6D", 9),
]
GROUPS = st.lists(
    st.tuples(st.sampled_from(KINDS), st.sampled_from(["ABSOLUTE", "RELATIVE", "DELTA"])),
    min_size=1,
    max_size=5,
)


def groups_of(
    drawn: list[tuple[tuple[str, str, int], str]],
) -> tuple[list[dict[str, Any]], list[int]]:
    groups = [{"rep": rep, "type": kind, "format": form} for (kind, form, _), rep in drawn]
    return groups, [width for (_, _, width), _ in drawn]


@settings(max_examples=300, deadline=None)
@given(GROUPS, st.booleans(), st.data())
def test_a_checkpoint_with_mixed_groups_keeps_each_target(
    drawn: list[tuple[tuple[str, str, int], str]], converts: bool, data: st.DataObject
) -> None:
    groups, widths = groups_of(drawn)
    spec = gr00t._action_spec(groups, widths, converts=converts)
    dim = sum(widths)
    assert spec.dim == dim
    forms = {form for (_, form, _), _ in drawn if form != "DEFAULT"}
    is_described = converts and len(forms) < 2 and any(rep != "ABSOLUTE" for _, rep in drawn)
    assert (spec.relative is not None) == is_described
    if not is_described:
        return

    values = st.lists(st.floats(-2.0, 2.0, width=32), min_size=dim, max_size=dim)
    last = np.array(data.draw(values), np.float32)
    commands = [SafeAction("auto", spec)(Obs(), last)]
    clock = ClockConfig(latency=0.2, mode="async")
    executor = ChunkExecutor(None, clock, Contract(action=spec, control_hz=10.0), last)
    commands.append(next(executor.ticks(last[np.newaxis], 0.2)).action)

    start = 0
    for (_, form, width), rep in drawn:
        part = slice(start, start + width)
        for command in commands:
            if rep != "DELTA":
                assert command[part].tolist() == last[part].tolist()
            elif form == "XYZ_ROT6D":
                assert command[part].tolist() == [0, 0, 0, 1, 0, 0, 0, 1, 0]
            else:
                assert not command[part].any()
        start += width


def family_specs() -> list[Any]:
    specs = [
        pytest.param(convention.action, id=f"openpi {name}")
        for name, convention in openpi.ROBOTS.items()
        if convention.action is not None
    ]
    specs.append(pytest.param(octo._action_spec(7, "bridge_dataset"), id="octo"))
    for dim, absolute in itertools.product((10, 20), (False, True)):
        spec = diffusion_policy._action_spec(dim, absolute=absolute)
        specs.append(pytest.param(spec, id=f"diffusion policy {dim} {absolute}"))
    return specs


@pytest.mark.parametrize("spec", family_specs())
def test_a_safe_action_keeps_the_targets_and_grippers_of_each_family(spec: ActionSpec) -> None:
    columns = Columns.from_spec(spec, spec.dim or 0)
    last = np.random.default_rng(0).uniform(-1, 1, columns.dim).astype(np.float32)
    safe = SafeAction("auto" if columns.is_known else "hold", spec)(Obs(), last)
    absolute = list(columns.absolute)
    assert safe[absolute].tolist() == last[absolute].tolist()
    assert columns.motion(safe.tolist(), safe.tolist()) == [0.0] * columns.dim


def test_both_grippers_of_aloha_are_declared() -> None:
    spec = openpi.ROBOTS["AlohaInputs"].action
    assert spec is not None
    columns = Columns.from_spec(spec, 14)
    assert (columns.grippers, columns.gripper_command(1.0)) == ((6, 13), 1.0)
