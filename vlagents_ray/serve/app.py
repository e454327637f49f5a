"""The import path of deployment files: `import_path: vlagents_ray.serve.app:build`."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from pydantic import ValidationError
from ray.serve import Application
from ray.serve.exceptions import RayServeException

from vlagents_ray.errors import VLAgentsError
from vlagents_ray.serve.config.deployment import ServerArgs
from vlagents_ray.serve.replica import app
from vlagents_ray.settings import wrong_settings

__all__ = ["build"]


def build(args: Mapping[str, Any] | ServerArgs) -> Application:
    """Build the Serve application of one policy from the `args` of a deployment file.

    Raises:
        RayServeException: A setting is wrong, or the policy's environment is missing. `serve status` shows only the
            text of this exception, but a traceback of forty lines for any other.
    """
    try:
        return app.build(ServerArgs.model_validate(args))
    except ValidationError as error:
        raise RayServeException(wrong_settings(error, ServerArgs)) from None
    except VLAgentsError as error:
        raise RayServeException(f"{type(error).__name__}: {error}") from None
