"""A line that says how far the work is, where somebody watches: in a terminal."""

from __future__ import annotations

import sys
import time

WIDTH = 30  # letters of the bar
INTERVAL = 0.1  # seconds between two lines


class Progress:
    """A bar on the standard error stream; nothing is written where that is no terminal.

    ``label`` stands before it; without one there is no bar.
    """

    def __init__(self, label: str | None, total: int) -> None:
        self.label, self.total, self.done = label, total, 0
        self._start = time.monotonic()
        self._shown = -INTERVAL
        self._visible = label is not None and sys.stderr is not None and sys.stderr.isatty()

    def add(self, count: int) -> None:
        """Count more of them as done."""
        self.done += count
        now = time.monotonic() - self._start
        if self._visible and now - self._shown >= INTERVAL:
            self._shown = now
            share = self.done / max(self.total, 1)
            bar = "#" * round(WIDTH * share)
            line = f"{self.label} |{bar:<{WIDTH}}| {self.done:,} of {self.total:,}, {now:.0f} s"
            print(f"\r{line}\033[K", end="", file=sys.stderr, flush=True)

    def close(self) -> None:
        """Leave an empty line."""
        if self._visible and self._shown >= 0:
            print("\r\033[K", end="", file=sys.stderr, flush=True)
