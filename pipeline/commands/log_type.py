"""A log on the command line: a file, a folder, or an address."""

from __future__ import annotations

import click

from scanchain.source import Source, source_of


class _LogType(click.ParamType):
    name = "log"

    def convert(self, value: str | Source, param: click.Parameter | None, ctx: click.Context | None) -> Source:
        """What a word names."""
        return source_of(value)


LOG = _LogType()
