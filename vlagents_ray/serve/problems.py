"""Errors as HTTP answers: problem+json documents."""

from __future__ import annotations

from starlette.responses import JSONResponse, Response

from vlagents_ray.errors import VLAgentsError
from vlagents_ray.wire.plain import PROBLEM_TYPE, problem


def problem_response(error: VLAgentsError, request_id: str, status: int | None = None) -> Response:
    """The document of an error, with its own status unless another is given."""
    document = problem(error, request_id)
    if status is not None:
        document["status"] = status
    return JSONResponse(document, status_code=document["status"], media_type=PROBLEM_TYPE)
