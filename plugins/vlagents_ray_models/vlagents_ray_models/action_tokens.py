"""The tokens of a flow step of π0: one token for the state, and one token for each noisy action
with the flow time.
"""

from __future__ import annotations

from typing import Any


def action_tokens(layers: Any, state: Any, actions: Any, time: Any) -> Any:
    """Return the embeddings of the tokens of a step, (B, 1 + H, D).

    transformers, openpi and LeRobot embed the state and the time in each step. Here, these
    embeddings are arguments, since they can be computed once for a whole flow.

    Args:
        layers: The module with `action_in_proj`, `action_time_mlp_in` and `action_time_mlp_out`.
        state: The embedding of the state, (B, D).
        actions: Noisy actions, (B, H, A).
        time: The embedding of the flow time, (B, D).
    """
    import torch  # torch's compiler follows this statement, but not `require`
    from torch.nn.functional import silu

    embedded = layers.action_in_proj(actions)
    with_time = torch.cat([embedded, time[:, None].expand_as(embedded)], 2)
    hidden = silu(layers.action_time_mlp_in(with_time))
    return torch.cat([state[:, None], layers.action_time_mlp_out(hidden)], 1)
