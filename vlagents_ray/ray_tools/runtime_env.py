"""A check for secrets in Ray runtime environments, which Ray writes to logs that every user of a
machine can read.
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping
from typing import Any

from vlagents_ray.errors import ConfigError

# Only the last word of a variable's name is checked, so that TOKENIZERS_PARALLELISM, HF_TOKEN_PATH
# and MAX_TOKENS pass.
_SECRET = re.compile(
    r"(^|_)(API|ACCESS)?KEY$|(TOKEN|SECRET|PASSWORD|PASSWD|PASSPHRASE|CREDENTIALS?)$", re.IGNORECASE
)
# Pip later replaces ${NAME} with the value of the variable.
_PASSWORD_IN_URL = re.compile(r"://[^/@\s:]*:(?!\$\{)[^/@\s]+@")


def require_no_secrets(runtime_env: Mapping[str, Any]) -> None:
    """Raise `ConfigError` if the name of a variable in `env_vars` looks like the name of a secret,
    or any URL contains a password.
    """
    variables = runtime_env.get("env_vars") or {}
    secrets: list[str] = []
    if isinstance(variables, Mapping):
        secrets = sorted(name for name in variables if _SECRET.search(name))
    if secrets:
        raise ConfigError(
            "env_vars: expected no secrets, as Ray logs them where every user of the machine can "
            f"read them, got {secrets}; set them in the environment in which Ray is started on "
            "each node (by `ray start`, `vlagents-ray serve`), or in a file that only you can "
            "read, and replace the secrets that were set here before"
        )

    if any(_PASSWORD_IN_URL.search(text) for text in _texts(runtime_env)):
        raise ConfigError(
            "runtime environment: expected no passwords, as Ray logs it where every user of the "
            "machine can read it, got a URL with one; put the password into ~/.netrc, or write "
            "${NAME} for a variable that the nodes have"
        )


def _texts(value: object) -> Iterator[str]:
    """Yield the texts in a value and in its nested mappings and lists. Keys are excluded."""
    if isinstance(value, str):
        yield value
    elif isinstance(value, Mapping):
        for item in value.values():
            yield from _texts(item)
    elif isinstance(value, (list, tuple)):
        for item in value:
            yield from _texts(item)
