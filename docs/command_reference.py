"""The directive ``command-reference``: usage, help and options of every command, read from the program itself."""

import inspect
import re
import textwrap
from collections.abc import Iterator

import click
from sphinx.application import Sphinx
from sphinx.util.docutils import SphinxDirective

from scanchain.__main__ import scanchain


class CommandReference(SphinxDirective):
    """A section for each command, subcommands included, in the order of ``scanchain --help``."""

    has_content = True  # for readers of the source

    def run(self) -> list:
        """Nodes of all sections."""
        text = "\n".join(line for name in scanchain.commands for line in _command("scanchain", name))
        return self.parse_text_to_nodes(text, allow_section_headings=True)


def _command(parent: str, name: str, group: click.Group = scanchain) -> Iterator[str]:
    """Markdown of a command and of those below it."""
    command = group.commands[name]
    path = f"{parent} {name}"
    ctx = click.Context(command, info_name=path, show_default=True)
    yield f"## {path}\n"
    yield f"```{{program}} {path}\n```\n"
    yield f"```text\n{ctx.get_usage().removeprefix('Usage: ')}\n```\n"
    yield from _help(command.help or "")
    for parameter in command.get_params(ctx):
        record = parameter.get_help_record(ctx)
        if record and record[0].startswith("-") and "--help" not in record[0]:
            yield f"````{{option}} {record[0]}\n{escaped(record[1])}\n````\n"
    if isinstance(command, click.Group):
        for child in command.commands:
            yield from _command(path, child, command)


def _help(text: str) -> Iterator[str]:
    """Markdown of a help text: paragraphs, and what must not be reflowed as it stands."""
    for paragraph in re.split(r"\n\s*\n", inspect.cleandoc(text)):
        if not paragraph.startswith("\b"):
            yield f"{escaped(paragraph)}\n"
            continue
        head, _, rest = paragraph.removeprefix("\b\n").partition("\n")
        if rest and head.endswith((":", " of")):
            yield f"{escaped(head)}\n"
            paragraph = rest
        yield f"```text\n{textwrap.dedent(paragraph.removeprefix(chr(8)).lstrip(chr(10)))}\n```\n"


def escaped(text: str) -> str:
    """Plain text as Markdown that shows it unchanged, options as code."""
    text = re.sub(r"([\\`*_<>\[\]|#{}])", r"\\\1", text)
    return re.sub(r"(?<!\S)--[\w.-]*\w", lambda option: f"`{option[0]}`", text)


def setup(app: Sphinx) -> dict[str, bool]:
    """Called by Sphinx."""
    app.add_directive("command-reference", CommandReference)
    return {"parallel_read_safe": True}
