"""The interface of a web page that shows an evaluation while it runs; a plug-in registers the page
in `vlagents_ray.pages`.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Collection
from contextlib import AbstractContextManager
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from vlagents_ray.evaluate.report.results_document import ResultsDocument
    from vlagents_ray.serve.access.api_keys import Keys


class EvaluationPage(ABC):
    """A web page that shows an evaluation while it runs."""

    @abstractmethod
    def serve(
        self,
        document: ResultsDocument,
        apps: Collection[str],
        address: tuple[str, int],
        keys: Keys | None,
    ) -> AbstractContextManager[str]:
        """Return a context manager that serves the page and yields its URL.

        Args:
            document: The progress and the results.
            apps: The applications in this process's cluster whose sessions the page shows.
            address: The host and port to listen on; port 0 selects a free port.
            keys: The accepted keys; None admits all clients, and is allowed only on a loopback
                address.

        Raises:
            ConfigError: Other machines could reach the page without a key, or the address is in
                use.
        """
