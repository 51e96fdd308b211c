"""A command that takes any configuration key as ``--section.key value``."""

from __future__ import annotations

import click

from pipeline.settings import Override


class OverrideCommand(click.Command):
    """Takes flags with a dot in their name out of the arguments before click sees the rest."""

    def parse_args(self, ctx: click.Context, args: list[str]) -> list[str]:
        """Split the arguments into overrides, kept in the context, and ordinary ones."""
        rest: list[str] = []
        overrides: list[Override] = []
        words = iter(args)
        for word in words:
            if word == "--":
                rest += [word, *words]
                break
            flag, equals, text = word.partition("=")
            if not flag.startswith("--") or "." not in flag:
                rest.append(word)
                continue
            if not equals:
                text = next(words, "")
                if not text:
                    raise click.UsageError(f"{flag} needs a value, as in {flag} VALUE", ctx)
            overrides.append(Override(flag[2:], text, flag))
        ctx.meta[_KEY] = tuple(overrides)
        return super().parse_args(ctx, rest)


def overrides(ctx: click.Context) -> tuple[Override, ...]:
    """The ``--section.key`` flags of a command, in their order."""
    return ctx.meta[_KEY]


_KEY = "pipeline.commands.overrides"
