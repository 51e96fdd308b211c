"""Writes what kernels are compiled for, ``kernels/signatures.json``, by runs without a cache:

python -m tests.support.signatures
"""

import json
import os
import subprocess
import sys
from pathlib import Path
from tempfile import TemporaryDirectory

from numba import types
from numba.core.dispatcher import Dispatcher

from scanchain import ahead, kernels
from scanchain.__main__ import main

_RUNS = {
    "2d": ("run {0}/office.mcap --out {0}/office",),
    "3d": ("run {0}/town.mcap --out {0}/town",),
    "rest": (
        "simulate office {0}/later.mcap --duration 21 --changed 1",
        "localize {0}/later.mcap --map {0}/office --out {0}/found",
        "run {0}/later.mcap --out {0}/again --rerun off --error-bars quick --matcher svd",
        "merge {0}/office {0}/again --out {0}/merged",
        "simulate town {0}/soon.mcap --duration 9 --changed 1",
        "localize {0}/soon.mcap --map {0}/town --out {0}/near",
        "run {0}/soon.mcap --out {0}/there --rerun off --error-bars quick --matcher svd",
        "merge {0}/town {0}/there --out {0}/both",
        "simulate turns {0}/turns.mcap --duration 4 --imu mems",
        "run {0}/turns.mcap --out {0}/turns --rerun off --error-bars quick --odometry.prior constant-velocity",
    ),
}


def compiled():
    """(name, argument types) of everything that this process has compiled or taken from the cache."""
    found = {}
    for module in [each for name, each in sys.modules.items() if name.startswith(f"{kernels.__name__}.")]:
        for value in vars(module).values():
            if isinstance(value, Dispatcher) and value.py_func.__module__.startswith(kernels.__name__):
                found[ahead.name_of(value)] = value
    for name, kernel in sorted(found.items()):
        for signature in kernel.overloads:
            yield name, signature


def words_of(signature, tuples):
    """Words of the table for types, tuples by their names, to which those met are added; None of other types."""
    words = []
    for each in signature:
        if isinstance(each, types.NamedTuple | types.NamedUniTuple):
            kind = each.instance_class
            module = kind.__module__.removeprefix("scanchain.")
            fields = words_of(list(each), tuples)
            known = tuples.setdefault(kind.__name__, {"class": f"{module}:{kind.__name__}", "types": fields})
            if known["types"] != fields:
                return None  # a second kind of it is compiled as it is called
            words.append(kind.__name__)
        elif isinstance(each, types.UniTuple):
            words.append(f"{each.count} {each.dtype}")
        elif isinstance(each, types.Array):
            dtype = "boolean" if each.dtype == types.boolean else each.dtype
            words.append(f"{'' if each.mutable else 'readonly '}{dtype} {each.ndim}{each.layout}")
        else:
            words.append("boolean" if each == types.boolean else str(each))
            if not isinstance(each, types.Number | types.Boolean) or isinstance(each, types.Literal):
                return None
    return words


def record(place, kind, *, is_cold=False):
    """Run what a kind needs, and write what it called as the table has it; if cold, what was compiled as well."""
    if is_cold:
        ahead.compile_ahead = lambda *_: True  # before other modules take it by its name
    for words in _RUNS[kind]:
        assert main([*words.format(place).split(), "--force"]) in (0, 1), words
    tuples = {}
    found = [
        [name, *words] for name, signature in compiled() if (words := words_of(signature, tuples)) is not None
    ]
    Path(place, f"{kind}.json").write_text(json.dumps([tuples, found]))


def _recorded(place, kind, cache):
    environment = os.environ | {"NUMBA_CACHE_DIR": str(cache), "SCANCHAIN_THREADS": "1"}
    subprocess.run([sys.executable, "-m", __spec__.name, place, kind, "cold"], env=environment, check=True)
    return json.loads(Path(place, f"{kind}.json").read_text())


def write():
    """Write the table: a line for each signature, with the kinds that need it."""
    tuples, kinds = {}, {}
    with TemporaryDirectory() as place:
        for words in ("office {0}/office.mcap --duration 20", "town {0}/town.mcap --duration 8"):
            main(["simulate", *words.format(place).split()])
        for kind in _RUNS:
            named, found = _recorded(place, kind, Path(place, "cache", kind))
            for name, fields in named.items():
                assert tuples.setdefault(name, fields) == fields, name
            for each in found:
                kinds.setdefault(tuple(each), []).append(kind)
    rows = [
        [[kind for kind in needed if kind != "rest"] or needed, *each] for each, needed in sorted(kinds.items())
    ]
    lines = [f'    "{name}": {json.dumps(fields)}' for name, fields in tuples.items()]
    text = '{\n  "tuples": {\n' + ",\n".join(lines) + '\n  },\n  "kernels": [\n'
    text += ",\n".join(f"    {json.dumps(row)}" for row in rows) + "\n  ]\n}\n"
    ahead.TABLE.write_text(text)


if __name__ == "__main__":
    record(*sys.argv[1:3], is_cold="cold" in sys.argv) if sys.argv[1:] else write()
