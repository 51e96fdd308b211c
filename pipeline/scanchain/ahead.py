"""Parallel compilation of kernels before the first run that needs them, one process per core.

Numba compiles a kernel together with those that it calls, in sequence. Here a kernel is compiled as soon as those
that it calls are in the cache: each kernel once, independent ones in parallel.
"""

from __future__ import annotations

import json
import re
import subprocess
import sys
from collections.abc import Callable, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, ThreadPoolExecutor, wait
from contextlib import ExitStack, suppress
from functools import cache
from graphlib import TopologicalSorter
from hashlib import sha256
from importlib import import_module
from pathlib import Path
from typing import Any, NamedTuple

import numba
from llvmlite import binding
from numba import config, types
from numba.core.dispatcher import Dispatcher

from scanchain.clock import standing_still
from scanchain.kernels import compiling  # which chooses the folder
from scanchain.threads import threads

TABLE = Path(compiling.__file__).with_name("signatures.json")
KINDS = "2d", "3d", "rest"  # kernels needed by 2D runs, by 3D runs, and by everything else


class Signature(NamedTuple):
    """Argument types that a kernel, ``module:function``, is compiled for, and the kinds of run that need it."""

    kernel: str
    kinds: tuple[str, ...]
    types: tuple[types.Type, ...]


def compile_ahead(kinds: Sequence[str], count: Callable[[int, int], None]) -> bool:
    """True if the cache has all kernels of these kinds; what it lacks is compiled now.

    False if there is no cache folder or a process ended early; kernels are then compiled when first called.
    count : callback with the number of kernels compiled so far and the total
    """
    folder: str = config.CACHE_DIR  # pyright: ignore[reportAttributeAccessIssue]
    if not folder or config.DISABLE_JIT:  # pyright: ignore[reportAttributeAccessIssue]
        return False
    marks = {kind: Path(folder, f"{kind}-{_state()}.compiled") for kind in kinds}
    missing = [kind for kind, mark in marks.items() if not mark.exists()]
    if not missing:
        return True
    with standing_still():
        # the longest chain of calls takes an eighth of the total time
        is_whole = _compile_all(missing, min(threads(), 8), count)
    with suppress(OSError):
        for kind in missing if is_whole else ():
            marks[kind].touch()
    return is_whole


@cache
def _state() -> str:
    """Hash of what compiled code depends on, the folder of the sources included, by which Numba caches."""
    parts = sys.version, numba.__version__, binding.get_host_cpu_name(), compiling.digest_of_sources(), str(TABLE)
    return sha256(repr(parts).encode() + TABLE.read_bytes()).hexdigest()[:16]


def _compile_all(kinds: Sequence[str], cores: int, count: Callable[[int, int], None]) -> bool:
    """True if no process ended early."""
    names = {each.kernel for each in signatures(kinds)}
    calls = {name: _called(_named(name), names) - {name} for name in names}
    heights = _heights(calls)
    order = TopologicalSorter(calls)
    order.prepare()
    ready: list[str] = []
    done, is_whole, running = 0, True, dict[Future[bool], tuple[str, _Worker]]()
    with ThreadPoolExecutor(cores) as pool, ExitStack() as stack:  # kills processes that threads wait for
        workers = [stack.enter_context(_Worker(kinds)) for _ in range(cores)]
        while order.is_active() and (workers or running):
            ready = sorted([*ready, *order.get_ready()], key=heights.__getitem__)
            while ready and workers:
                worker, name = workers.pop(), ready.pop()
                running[pool.submit(worker.compile, name)] = name, worker
            for future in wait(running, return_when=FIRST_COMPLETED).done:
                name, worker = running.pop(future)
                order.done(name)
                if future.result():
                    workers.append(worker)
                is_whole = is_whole and future.result()
                done += 1
                count(done, len(names))
    return is_whole


class _Worker:
    """A process that compiles kernels on request. A context manager."""

    def __init__(self, kinds: Sequence[str]) -> None:
        self.process = subprocess.Popen(
            [sys.executable, "-P", "-m", __name__, *kinds],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=subprocess.DEVNULL,
            text=True,
        )

    def __enter__(self) -> _Worker:
        return self

    def __exit__(self, *raised: object) -> None:
        self.process.kill()
        self.process.communicate()

    def compile(self, name: str) -> bool:
        """True once the kernel is compiled, False where the process has ended."""
        assert self.process.stdin is not None and self.process.stdout is not None
        try:
            print(name, file=self.process.stdin, flush=True)
        except OSError:
            return False
        return self.process.stdout.readline() != ""


def _heights(calls: dict[str, set[str]]) -> dict[str, int]:
    """Priority of each kernel: bytes of code on the longest chain of its callers, its own included."""
    callers: dict[str, set[str]] = {name: set() for name in calls}
    for name, called in calls.items():
        for each in called:
            callers[each].add(name)

    @cache
    def height(name: str) -> int:
        return len(_named(name).py_func.__code__.co_code) + max(map(height, callers[name]), default=0)

    return {name: height(name) for name in calls}


def _called(kernel: Dispatcher, names: set[str]) -> set[str]:
    """Those of the named kernels that a kernel calls, directly or through an inlined kernel."""
    found: set[str] = set()
    for word in kernel.py_func.__code__.co_names:
        other = kernel.py_func.__globals__.get(word)
        if isinstance(other, Dispatcher):
            name = name_of(other)
            found |= {name} if name in names else _called(other, names)
    return found


def name_of(kernel: Dispatcher) -> str:
    """``module:function``, the module without ``scanchain``."""
    function = kernel.py_func
    return f"{function.__module__.removeprefix('scanchain.')}:{function.__name__}"


def _named(name: str) -> Any:
    """Kernel or class named ``module:name``; the inverse of ``name_of``."""
    module, _, function = name.partition(":")
    return getattr(import_module(f"scanchain.{module}"), function)


def signatures(kinds: Sequence[str] = KINDS) -> list[Signature]:
    """Signatures of the table that at least one of the kinds needs."""
    table = json.loads(TABLE.read_text())
    known = dict[str, types.Type]()
    for name, fields in table["tuples"].items():
        of = [_type_of(each, known) for each in fields["types"]]
        is_uniform = all(each == of[0] for each in of)
        class_ = _named(fields["class"])
        known[name] = types.NamedUniTuple(of[0], len(of), class_) if is_uniform else types.NamedTuple(of, class_)
    return [
        Signature(name, tuple(needed), tuple(_type_of(each, known) for each in words))
        for needed, name, *words in table["kernels"]
        if set(needed) & set(kinds)
    ]


def _type_of(word: str, known: dict[str, types.Type]) -> types.Type:
    """Type that a word of the table names: a scalar, ``readonly float64 2C``, ``21 float64``, or a named tuple."""
    if word in known:
        return known[word]
    if many := re.fullmatch(r"(\d+) (\w+)", word):
        return types.UniTuple(getattr(types, many[2]), int(many[1]))
    if array := re.fullmatch(r"(readonly )?(\w+) (\d)([CA])", word):
        return types.Array(getattr(types, array[2]), int(array[3]), array[4], readonly=bool(array[1]))
    return getattr(types, word)


def _work(kinds: Sequence[str]) -> None:
    """Compile the kernels named on standard input, one per line; acknowledge each with an empty line."""
    table = signatures(kinds)
    for line in sys.stdin:
        for each in table:
            if each.kernel == line.strip():
                _named(each.kernel).compile(each.types)
        sys.stdout.write("\n")
        sys.stdout.flush()


if __name__ == "__main__":
    _work(sys.argv[1:])
