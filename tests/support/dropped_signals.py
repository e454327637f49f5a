"""A signal whose handler's exception Python drops."""

from __future__ import annotations

import signal


class SendsSignal:
    """Sends this process a signal in its destructor, so that Python drops the exception of the
    signal's handler.
    """

    def __init__(self, number: signal.Signals) -> None:
        self.number = number

    def __del__(self) -> None:
        signal.raise_signal(self.number)
