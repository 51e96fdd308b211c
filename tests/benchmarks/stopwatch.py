"""Adds up the time that passes in functions of a program, what they call of each other counted once."""

from __future__ import annotations

import threading
from collections.abc import Callable
from functools import wraps
from time import perf_counter
from typing import Any


class Stopwatch:
    """Measures whoever it is put over.

    ``seconds`` by stage: in the main thread, and in all others together.
    """

    def __init__(self) -> None:
        self.seconds: dict[str, tuple[float, float]] = {}
        self.inner = threading.local()
        self.lock = threading.Lock()

    def over(self, stage: str, owner: Any, *names: str) -> None:
        """Measure functions of a module or methods of a class from now on."""
        for name in names:
            setattr(owner, name, self.timed(stage, getattr(owner, name)))

    def timed(self, stage: str, function: Callable[..., Any]) -> Callable[..., Any]:
        """The function, measured."""
        self.add(stage, 0.0)

        @wraps(function)
        def measured(*arguments: Any, **options: Any) -> Any:
            outside_s, self.inner.seconds = getattr(self.inner, "seconds", 0.0), 0.0
            started = perf_counter()
            try:
                return function(*arguments, **options)
            finally:
                whole_s = perf_counter() - started
                self.add(stage, whole_s - self.inner.seconds)
                self.inner.seconds = outside_s + whole_s

        return measured

    def add(self, stage: str, seconds: float) -> None:
        """Count what was measured otherwise."""
        is_main = threading.current_thread() is threading.main_thread()
        with self.lock:
            main_s, beside_s = self.seconds.get(stage, (0.0, 0.0))
            self.seconds[stage] = main_s + seconds * is_main, beside_s + seconds * (not is_main)
