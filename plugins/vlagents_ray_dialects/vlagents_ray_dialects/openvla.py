"""OpenVLA's REST protocol: `POST /act` with an observation; the reply is an action.

An error has its HTTP status; OpenVLA's own server replies to it with 200 and "error".
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, ClassVar

import numpy as np
from pydantic import Field
from starlette.requests import Request as HttpRequest
from starlette.responses import Response

from vlagents_ray.errors import InvalidObservation
from vlagents_ray.interface import Obs
from vlagents_ray.protocol.messages import Budget
from vlagents_ray.serve.config.dialects import DialectConfig, MappingSetting
from vlagents_ray.serve.dialects.base import HttpDialect
from vlagents_ray_dialects.messages import openvla
from vlagents_ray_dialects.messages.openvla import PRESETS


class OpenVLADialectConfig(DialectConfig):
    """The settings of the REST clients of OpenVLA, and of the forks of OpenVLA that post whole
    observations.
    """

    mapping: MappingSetting = "openvla"
    chunk: bool = Field(
        default=False,
        description="whether the answer has all rows, as OFT's clients need it, or only the first",
    )
    plain: bool = Field(
        default=False,
        description="whether the answer has lists of numbers, as GO-1's clients read them, instead "
        "of arrays",
    )


class OpenVLADialect(HttpDialect):
    """OpenVLA's protocol, which has no sessions unless the client names one."""

    Config = OpenVLADialectConfig
    clients = "OpenVLA"
    summary = (
        "An episode is one request, unless that names a session. An error has its status and "
        "problem+json."
    )
    paths: ClassVar[Mapping[str, str]] = {"POST /act": "act"}
    presets = PRESETS
    config: OpenVLADialectConfig

    def read(self, theirs: Any) -> tuple[Obs, str | None]:
        """Convert a client's observation.

        Args:
            theirs: The observation.

        Returns:
            Our observation, and the instruction.

        Raises:
            InvalidObservation: The mapping has a key of the instruction, and the observation has no
                instruction.
        """
        obs, instruction = super().read(theirs)
        if instruction is None and self.mapping.instruction is not None:
            raise InvalidObservation(
                "instruction: expected one, as the policy needs it, got none; send it with the "
                "observation"
            )
        return obs, instruction

    async def act(self, http: HttpRequest) -> Response:
        """Answer one request. The reply is encoded once or twice, like the request."""
        twice = False

        def read(data: bytes, budget: Budget) -> dict[str, Any]:
            """Decode the observation in a request."""
            nonlocal twice
            theirs, twice = openvla.decode(data, budget.limits)
            return theirs

        def write(rows: np.ndarray) -> bytes:
            """Encode the action of a reply."""
            action = rows if self.config.chunk else rows[0]
            if self.config.plain:
                return openvla.encode(action.tolist(), twice)
            columns = self.mapping.columns(action)
            if columns:
                return openvla.encode(columns, twice)
            return openvla.encode(list(rows) if self.config.chunk else action, twice)

        return await self.answer(http, read, write)
