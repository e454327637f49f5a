"""Given rows with errors, and labels that return to the demonstrated path."""

from __future__ import annotations

from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

torch = pytest.importorskip("torch")
pytestmark = pytest.mark.torch


@settings(deadline=None, max_examples=100)
@given(
    seed=st.integers(0, 2**31 - 1),
    horizon=st.integers(1, 20),
    half_range=st.floats(0.01, 100.0),
    center=st.floats(-1.0, 1.0),
)
def test_each_column_returns_by_its_meaning(
    seed: int, horizon: int, half_range: float, center: float
) -> None:
    """The columns are a motion, a target and a gripper, with other limits than 1."""
    from vlagents_ray.policies.prefixes import with_errors

    draws = torch.Generator().manual_seed(seed)
    low = torch.tensor([-1.0, center - 1, -1]) * half_range
    high = torch.tensor([1.0, center + 1, 1]) * half_range
    shares = torch.rand(16, horizon, 3, generator=draws)
    actions = low + (0.25 + 0.5 * shares) * (high - low)
    lengths = torch.randint(0, horizon + 1, (16,), generator=draws)
    columns: dict[str, Any] = {
        "relative": torch.tensor([True, False, False]),
        "targets": torch.tensor([False, True, False]),
    }
    rows = with_errors(
        actions, lengths, columns.pop("relative"), draws, **columns, low=low, high=high
    )

    slack = 1e-4 * half_range
    assert torch.equal(rows[lengths == 0], actions[lengths == 0])
    assert torch.equal(rows[..., 2], actions[..., 2])
    assert (rows >= low - slack).all()
    assert (rows <= high + slack).all()
    for chunk, demonstrated, length in zip(rows, actions, lengths.tolist(), strict=True):
        # Targets return at once.
        assert torch.equal(chunk[length:, 1], demonstrated[length:, 1])
        # Motions return as fast as the limits allow: a row is at a limit, or on the path.
        ahead = (chunk[:, 0].cumsum(0) - demonstrated[:, 0].cumsum(0))[length:]
        at_limit = (chunk[length:, 0].abs() - half_range).abs() < slack
        assert ((ahead.abs() < slack * horizon) | at_limit).all()
