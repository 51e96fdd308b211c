"""Classes that the configuration names: those that come with the package, and a user's own as MODULE:CLASS."""

from __future__ import annotations

import os
import re
import sys
from importlib import import_module

from scanchain.errors import InputError

MATCHERS = {
    "plicp": "scanchain.registration.plicp:PointToShapeMatcher",
    "svd": "scanchain.registration.svd_icp:SvdMatcher",
}


def is_class_name(text: str) -> bool:
    """Whether a text has the form ``package.module:Class``."""
    return re.fullmatch(r"[^\W\d]\w*(\.[^\W\d]\w*)*:[^\W\d]\w*", text) is not None


def load_class(name: str, verb: str) -> type:
    """The class called ``package.module:Class``, which has a method of that name.

    The module is looked for wherever Python looks (PYTHONPATH, installed packages) and, after all that, in the
    working directory, also by processes started with ``python -P``. Raises InputError where there is none.
    """
    module_name, _, class_name = name.partition(":")
    if os.getcwd() not in sys.path and not module_name.startswith("scanchain."):
        sys.path.append(os.getcwd())
    try:
        module = import_module(module_name)
    except ModuleNotFoundError as error:
        if not f"{module_name}.".startswith(f"{error.name}."):
            raise InputError(f"{name}: {module_name} needs the module {error.name}; install it") from error
        raise InputError(
            f"{name}: there is no module {error.name} on PYTHONPATH or in {os.getcwd()}; check the name"
        ) from error
    except Exception as error:  # a user's code may raise anything
        reason = " ".join(str(error).split())
        raise InputError(f"{name}: importing {module_name} fails: {type(error).__name__}: {reason}") from error
    found = getattr(module, class_name, None)
    if not isinstance(found, type):
        raise InputError(f"{name}: {module.__file__} has no class {class_name}; check the name")
    if not callable(getattr(found, verb, None)):
        raise InputError(f"{name}: the class has no method {verb}; see the documentation, Extending")
    return found
