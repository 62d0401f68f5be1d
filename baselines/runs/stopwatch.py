"""Where the time of a training goes."""

import time


class Stopwatch:
    """Adds up seconds: each lap is booked under a name."""

    def __init__(self) -> None:
        self.seconds: dict[str, float] = {}
        self._last = time.perf_counter()

    def lap(self, name: str) -> None:
        """Book the time since the last lap under `name`."""
        now = time.perf_counter()
        self.seconds[name] = self.seconds.get(name, 0.0) + now - self._last
        self._last = now

    @property
    def total(self) -> float:
        """Seconds of all laps, those before a resumption included."""
        return sum(self.seconds.values())

    def __str__(self) -> str:
        total = max(self.total, 1e-9)
        parts = [f"{name} {100 * s / total:.0f} %" for name, s in self.seconds.items()]
        return f"{self.total:.1f} s: " + ", ".join(parts)
