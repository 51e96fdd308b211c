"""Results of Numba's compiler, cached, that it computes again at each call of an operator and after each pass."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

from numba.core.errors import termcolor
from numba.core.inline_closurecall import InlineWorker
from numba.core.postproc import PostProcessor, VariableLifetime
from numba.core.targetconfig import ConfigStack
from numba.core.transforms import canonicalize_cfg
from numba.core.types.functions import BaseFunction

_Colors: Any = type(termcolor())
_resolve, _process, _interpret = BaseFunction.get_call_type, PostProcessor.run, InlineWorker.run_untyped_passes
_color = _Colors.errmsg
_signatures: dict[Any, Any] = {}  # of Numba's functions and operators, by the types of their arguments
_interpreted: dict[Any, Any] = {}  # functions to be inlined, which Numba copies before it changes them


@contextmanager
def shortcuts() -> Iterator[None]:
    """Numba's compiler with the functions below in place of its own; by the thread that holds its lock."""
    BaseFunction.get_call_type = _get_call_type
    PostProcessor.run = _run
    InlineWorker.run_untyped_passes = _run_untyped_passes
    _Colors.errmsg = _uncolored
    try:
        yield
    finally:
        BaseFunction.get_call_type = _resolve
        PostProcessor.run = _process
        InlineWorker.run_untyped_passes = _interpret
        _Colors.errmsg = _color


def _get_call_type(self: Any, context: Any, args: Any, kws: Any) -> Any:
    """Signature of one of Numba's functions for these types; Numba tries all that the function has each time."""
    flags = ConfigStack.top_or_none()
    key = self, args, tuple(kws.items()), flags and flags.forceinline  # which what is called inherits
    if key not in _signatures:
        _signatures[key] = _resolve(self, context, args, kws)
    return _signatures[key]


def _run(self: Any, emit_dels: bool = False, extend_lifetimes: bool = False) -> None:
    """Canonical control flow of a function; which variables live where is needed before lowering only."""
    ir = self.func_ir
    if emit_dels or ir.is_generator:
        _process(self, emit_dels, extend_lifetimes)
        return
    ir.blocks, ir.generator_info = canonicalize_cfg(ir.blocks), None
    ir.variable_lifetime = VariableLifetime(ir.blocks)  # determined where it is asked for


def _run_untyped_passes(self: Any, func: Any, enable_ssa: bool = False) -> Any:
    """Intermediate representation of a function to be inlined, of which Numba makes one at each call."""
    key = func, enable_ssa
    if key not in _interpreted:
        _interpreted[key] = _interpret(self, func, enable_ssa)
    return _interpreted[key]


def _uncolored(self: Any, message: str) -> str:
    """Message of an error, most of which only say that another function is to be tried."""
    return message
