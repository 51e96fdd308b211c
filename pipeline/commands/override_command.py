"""What every command is: options of one value are given once, and some take any configuration key as an option."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from typing import Any

import click

from scanchain.settings import Override


class OnceCommand(click.Command):
    """Refuses an option given twice that holds one value: the last would win without a word."""

    def parse_args(self, ctx: click.Context, args: list[str]) -> list[str]:
        """Parse the arguments once for what is named twice, then as usual."""
        _, _, named = self.make_parser(ctx).parse_args(args=list(args))
        for parameter, count in Counter(named).items():
            if count > 1 and isinstance(parameter, click.Option) and _holds_one_value(parameter):
                raise click.UsageError(f"{parameter.opts[0]} is given {count} times; give it once", ctx)
        return super().parse_args(ctx, args)


def _holds_one_value(option: click.Option) -> bool:
    return not (option.multiple or option.is_flag or option.count)


class OverrideCommand(OnceCommand):
    """Takes any configuration key as ``--section.key value``.

    Options with a dot in their name are taken out of the arguments before click sees the rest.
    """

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


def overrides(ctx: click.Context, aliases: Sequence[Override] = ()) -> tuple[Override, ...]:
    """The keys that a command's options set: ``aliases`` as --matcher, and the ``--section.key`` options.

    Raises click.UsageError where two of them set the same key.
    """
    chosen: dict[str, Override] = {}
    for override in (*aliases, *ctx.meta[_KEY]):
        other = chosen.setdefault(override.key, override)
        if other is override:
            continue
        if other.flag == override.flag:
            raise click.UsageError(
                f"{other.flag} is given twice ({other.text}, {override.text}); give it once", ctx
            )
        raise click.UsageError(f"{other.flag} and {override.flag} both set {override.key}; give one of them", ctx)
    return tuple(chosen.values())


def alias(key: str, value: Any, flag: str) -> tuple[Override, ...]:
    """The key that an option of its own sets, none where the option was not given."""
    return () if value is None else (Override(key, str(value), flag),)


_KEY = "scanchain.commands.overrides"
