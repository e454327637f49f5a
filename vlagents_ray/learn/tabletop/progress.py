"""How a run of learning shows its progress: lines, and on a terminal a bar below them."""

from __future__ import annotations

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn


class LearnBar(Progress):
    """A bar of the iterations of all methods."""

    def __init__(self, console: Console) -> None:
        """Show it on that console, if it is a terminal."""
        columns = TextColumn("iterations"), BarColumn(), MofNCompleteColumn(), TimeRemainingColumn()
        super().__init__(*columns, console=console, disable=not console.is_terminal)
        self._bar = self.add_task("learn", total=None)

    def say(self, text: str) -> None:
        """Print a line about what was done."""
        self.console.print(text)

    def at(self, iteration: int, total: int) -> None:
        """Show how many iterations are done."""
        self.update(self._bar, completed=iteration, total=total)
