"""Training chunks that begin with given rows, for policies that are trained to continue them.

The rows that a robot executes until an answer arrives are given to the policy as a prefix
(training-time action conditioning, https://arxiv.org/abs/2512.05964). A policy that was trained
only with demonstrated rows learns to copy the plan that it is given, since in demonstrations the
plan and the future always fit. With errors in the given rows, and labels that return to the
demonstrated path, it also learns to correct the plan.
"""

from __future__ import annotations

from typing import Any

from vlagents_ray.registry import require

# The largest standard deviations of the errors, for the whole prefix and for each row, as a share
# of half the range of an action.
ERROR = 0.4


def with_errors(
    actions: Any,
    lengths: Any,
    relative: Any,
    draws: Any,
    *,
    targets: Any = None,
    low: Any = -1.0,
    high: Any = 1.0,
) -> Any:
    """Return chunks whose given rows have errors, and whose later rows return to the demonstrated
    path as fast as the limits of an action allow.

    A target leads back to the path by itself, so that the later rows of targets do not change. All
    arguments and the result are torch tensors.

    Args:
        actions: The demonstrated chunks, (B, H, D) within the limits.
        lengths: The number of given rows with errors of each chunk, (B,); 0 changes nothing.
        relative: Whether each value is relative, (B, D) or (D,) bool.
        draws: The generator of the errors.
        targets: Whether each value is a target whose given rows get errors, as `relative`; None for
            no value.
        low: The smallest value of an action, a number or (D,).
        high: The largest value of an action, a number or (D,).
    """
    torch = require("torch")
    size = ERROR * (high - low) / 2 * torch.rand(len(actions), 1, 1, generator=draws)
    errors = torch.randn(actions.shape, generator=draws)
    errors = size * (errors + torch.randn(actions[:, :1].shape, generator=draws))
    bounds = (torch.as_tensor(low), torch.as_tensor(high))

    path, reached = actions.cumsum(1), torch.zeros_like(actions[:, 0])
    rows = []
    for row in range(actions.shape[1]):
        is_given = (row < lengths)[:, None]
        returning = path[:, row] - reached
        step = torch.where(is_given, actions[:, row] + errors[:, row], returning).clamp(*bounds)
        reached = reached + step
        rows.append(step)

    has_errors = (lengths > 0)[:, None, None]
    changed = torch.where(has_errors & relative[..., None, :], torch.stack(rows, 1), actions)
    if targets is None:
        return changed
    is_given = torch.arange(actions.shape[1])[:, None] < lengths[:, None, None]
    wrong_targets = (actions + errors).clamp(*bounds)
    return torch.where(is_given & targets[..., None, :], wrong_targets, changed)
