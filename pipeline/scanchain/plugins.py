"""User-defined classes, named as ``module:Class`` in a configuration key."""

from __future__ import annotations

import importlib
import re
import sys
import traceback
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from scanchain.errors import InputError, OwnCodeError, one_line

CLASS_NAME = r"[^\W\d]\w*(\.[^\W\d]\w*)*:[^\W\d]\w*"


def is_class_name(text: str) -> bool:
    """True if a text has the form ``package.module:Class``."""
    return re.fullmatch(CLASS_NAME, text) is not None


def load(name: str, *methods: str) -> type:
    """The class that ``module:Class`` names: installed, on PYTHONPATH or else in the working directory.

    The working directory is appended to the search path only for a user's module: before that, nothing that
    happens to lie there is imported. Raises InputError where there is no such module or class, or the class
    lacks one of the methods.
    """
    module_name, _, class_name = name.partition(":")
    if not module_name or not class_name:
        raise InputError(f"{name!r} names no class; wanted module:Class, as in my_module:MyClass")
    here = str(Path.cwd())
    if not module_name.startswith("scanchain.") and here not in sys.path:
        sys.path.append(here)
    importlib.invalidate_caches()
    try:
        module = importlib.import_module(module_name)
    except Exception as error:  # whatever the module does at its top level
        reason = f"importing {module_name} failed with {_located(error)}"
        if isinstance(error, ModuleNotFoundError) and f"{module_name}.".startswith(f"{error.name}."):
            remedy = "go to its folder, or set PYTHONPATH to it"
            reason = f"there is no module {module_name} in {here} or on PYTHONPATH; {remedy}"
        raise OwnCodeError(f"{name}: {reason}") from error
    found = getattr(module, class_name, None)
    if not isinstance(found, type):
        raise InputError(f"{name}: {module.__file__} has no class {class_name}; check its name")
    for method in methods:
        if not callable(getattr(found, method, None)):
            needs = f"it needs {' and '.join(methods)} (documentation: Extending)"
            raise InputError(f"{name}: the class has no method {method}; {needs}")
    return found


@contextmanager
def own_code(where: str) -> Iterator[None]:
    """Convert every error of user-defined code into an OwnCodeError that says where."""
    try:
        yield
    except InputError as error:
        raise OwnCodeError(f"{where}: {error.text}") from error
    except Exception as error:
        raise OwnCodeError(f"{where} failed with {_located(error)}") from error


def _located(error: Exception) -> str:
    """Kind and message of an error, with the line of user-defined code that led to it, if any."""
    ours = (str(Path(__file__).parent), importlib.__file__, "<frozen ")
    own = [each for each in traceback.extract_tb(error.__traceback__) if not each.filename.startswith(ours)]
    lines = [f' (File "{e.filename}", line {e.lineno}, in {e.name})' for e in own if e.filename == own[0].filename]
    return f"{type(error).__name__}: {one_line(error)}{''.join(lines[-1:])}"
