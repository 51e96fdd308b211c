"""What a process may take, as flags: time and memory."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import click

_MIB_PER_GIB = 1024.0
_ABOVE_ZERO = click.FloatRange(0.0, min_open=True)


class _MemoryType(click.ParamType):
    """A number of GiB, handed on in MiB."""

    name = "memory"

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> float:
        return _MIB_PER_GIB * _ABOVE_ZERO.convert(value, param, ctx)


def limit_options(what: str, *, time_default: str, memory_default: str) -> Callable[[Any], Any]:
    """``--time-limit`` as ``time_limit`` in seconds, ``--memory-limit`` as ``memory_mib``; None where not given.

    what : that is limited; time_default, memory_default : what holds otherwise, in words
    """

    def decorate(command: Any) -> Any:
        for option in (
            click.option(
                "--memory-limit",
                "memory_mib",
                type=_MemoryType(),
                metavar="GIB",
                help=f"What {what} may take. [default: {memory_default}]",
            ),
            click.option(
                "--time-limit",
                type=_ABOVE_ZERO,
                metavar="SECONDS",
                help=f"What {what} may take. [default: {time_default}]",
            ),
        ):
            command = option(command)
        return command

    return decorate
