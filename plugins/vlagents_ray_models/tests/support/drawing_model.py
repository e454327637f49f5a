"""Model code that draws from torch's global generator, as that of several families does."""

from __future__ import annotations

from typing import Any

import torch


class Head(torch.nn.Module):
    def draw(self, batch: int) -> tuple[Any, Any]:
        noise = torch.randn(size=(batch, 3), dtype=torch.bfloat16, device=torch.device("cpu"))
        return torch.cat([noise.float(), torch.randn((batch, 2))], 1), torch.multinomial(
            torch.ones(batch, 50), 1
        )

    def draw_otherwise(self) -> Any:
        return torch.rand(2)


class Tuned(Head):
    """A class whose draws are those of its base."""
