"""Says what is being compiled, which happens once after an installation, and has it done on two cores."""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from typing import Any

from scanchain.runs.progress import Progress


@contextmanager
def telling_of_compilation(progress: Progress, rehearsal: Sequence[str] = ()) -> Iterator[None]:
    """Name each module of kernels as its compilation begins; what comes from the cache on disk is not named.

    rehearsal : ``python -m`` and these words compile, in a process beside this one, what it will need later
    """
    from numba.core import event

    class Telling(event.Listener):
        def __init__(self) -> None:
            self.modules: set[str] = set()
            self.beside: subprocess.Popen[bytes] | None = None

        def on_start(self, event: Any) -> None:
            module = event.data["dispatcher"].py_func.__module__
            if module.startswith("scanchain.") and module not in self.modules:
                if not self.modules:
                    progress.say("compiling, once after the installation:")
                    self.beside = _started(rehearsal)
                self.modules.add(module)
                progress.say(f"  {module.removeprefix('scanchain.')}")

        def on_end(self, event: Any) -> None:
            pass

    telling = Telling()
    try:
        with event.install_listener("numba:compile", telling):
            yield
    finally:
        if telling.beside is not None:
            telling.beside.kill()
            telling.beside.wait()


def _started(words: Sequence[str]) -> subprocess.Popen[bytes] | None:
    """``python -m`` with these words, whatever it has to say."""
    if not words:
        return None
    nothing = subprocess.DEVNULL
    return subprocess.Popen([sys.executable, "-P", "-m", *words], stdin=nothing, stdout=nothing, stderr=nothing)
