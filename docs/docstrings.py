"""Docstrings as reStructuredText: their lines ``name : meaning``, ``Returns …`` and ``Raises …`` become fields.

In signatures arrays are named as in the code.
"""

import re
from collections.abc import Iterator

from sphinx.application import Sphinx

_ENTRY = re.compile(r"(\w+(?:, \w+)*) : (.*)")
_RAISES = re.compile(r"Raises (\w+)[ :]*(.*)")
_ALIAS = re.compile(r"TypeAliasForwardRef\('(\w+)'\)")
_ARRAY = re.compile(r"[~.\w]*ndarray\[tuple\[[^]]*\], [~.\w]*dtype\[([^]]+)\]\]")
_CODE = re.compile(r"(``.+?``)")


def fields_of(app: Sphinx, what: str, name: str, obj: object, options: object, lines: list[str]) -> None:
    """Rewrite the lines of one docstring in place; Sphinx calls this for each, that of ``__init__`` apart."""
    is_of_class = what == "class" and lines[:1] == (obj.__doc__ or "").splitlines()[:1]
    lines[:] = list(_rewritten(lines, is_of_class))


def _rewritten(lines: list[str], is_of_class: bool) -> Iterator[str]:
    """Each block, which begins at a blank line or a field, after a blank line of its own.

    The fields of a class are its attributes, those of a function its arguments.
    """
    is_field = False
    for line in lines:
        text = line.strip()
        head = _head(line, is_of_class)
        if head:
            yield from ("", *head)
            is_field = True
        elif not text:
            is_field = False
            yield ""
        else:
            yield ("    " if is_field else "") + _escaped(text)


def _head(line: str, is_attributes: bool) -> tuple[str, ...]:
    """The first line of a field, empty where the line begins none."""
    if entry := _ENTRY.fullmatch(line):
        names, text = entry[1], _escaped(entry[2])
        if is_attributes:
            return ", ".join(f"``{name}``" for name in names.split(", ")), f"    {text}"
        return (f":param {names.replace(' ', '')}: {text}",)  # after a space Sphinx would take a name for a type
    if raised := _RAISES.match(line):
        return (f":raises {raised[1]}: {_escaped(raised[2])}",)
    return (f":returns: {_escaped(line.removeprefix('Returns '))}",) if line.startswith("Returns ") else ()


def _escaped(text: str) -> str:
    """The text with what reStructuredText would take for markup escaped, code aside."""
    return "".join(
        part if part.startswith("``") else re.sub(r"([\\*|`]|(?<=\w)_(?!\w))", r"\\\1", part)
        for part in _CODE.split(text)
    )


def signature_of(
    app: Sphinx, what: str, name: str, obj: object, options: object, arguments: str | None, returned: str | None
) -> tuple[str | None, str | None]:
    """Arguments and return annotation with the names of array types; Sphinx calls this for each signature."""
    return tuple(part and _ARRAY.sub(r"NDArray[\1]", _ALIAS.sub(r"\1", part)) for part in (arguments, returned))


def setup(app: Sphinx) -> dict[str, bool]:
    """Called by Sphinx."""
    app.connect("autodoc-process-signature", signature_of)
    app.connect("autodoc-process-docstring", fields_of)
    return {"parallel_read_safe": True}
