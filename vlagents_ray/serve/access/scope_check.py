"""Checks that the caller of a request may do what needs a scope."""

from __future__ import annotations

from vlagents_ray.errors import Forbidden
from vlagents_ray.serve.access.api_keys import Caller, current_caller


class ScopeCheck:
    """The check of one endpoint.

    Args:
        subject: What the endpoint is about, for the error message.
        open_to_network: Whether other machines reach this server without a key; then nobody may do it.
    """

    def __init__(self, subject: str, *, open_to_network: bool) -> None:
        self._subject = subject
        self._open_to_network = open_to_network

    def require(self, scope: str | None) -> None:
        """Check the key of the current request, and its scope if one is stated.

        Raises:
            Unauthorized: The key is revoked or has expired.
            Forbidden: It lacks the scope, or the server has no keys and other machines reach it.
        """
        caller = current_caller()
        if isinstance(caller, Caller):
            caller.admit(free=True, scope=scope)
        elif self._open_to_network:
            option = "" if scope is None else f" --scope {scope}"
            raise Forbidden(
                f"{self._subject}: not on a server with `--insecure`; make a key with `vlagents-ray keys new "
                f"NAME{option}` and serve with `--keys`, or serve on loopback without `--insecure`"
            )

    def may(self, scope: str) -> bool:
        """Return whether `require` would raise nothing."""
        caller = current_caller()
        return caller.refusal(scope) is None if isinstance(caller, Caller) else not self._open_to_network


def caller_name() -> str:
    """Return the name of the current request's key; empty without keys."""
    caller = current_caller()
    return caller.name if isinstance(caller, Caller) else ""
