"""Says what is being compiled, which happens once after an installation."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

from pipeline.runs.progress import Progress


@contextmanager
def telling_of_compilation(progress: Progress) -> Iterator[None]:
    """Name each module of kernels as its compilation begins; what comes from the cache on disk is not named."""
    from numba.core import event

    class Telling(event.Listener):
        def __init__(self) -> None:
            self.modules: set[str] = set()

        def on_start(self, event: Any) -> None:
            module = event.data["dispatcher"].py_func.__module__
            if module.startswith("pipeline.") and module not in self.modules:
                if not self.modules:
                    progress.say("compiling, once after the installation:")
                self.modules.add(module)
                progress.say(f"  {module.removeprefix('pipeline.')}")

        def on_end(self, event: Any) -> None:
            pass

    with event.install_listener("numba:compile", Telling()):
        yield
