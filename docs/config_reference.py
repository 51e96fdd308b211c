"""The directive ``configuration-reference``: every key with range, unit, defaults and what it sets."""

from collections.abc import Iterator

from command_reference import escaped
from msgspec.structs import fields
from sphinx.application import Sphinx
from sphinx.util.docutils import SphinxDirective

from scanchain.config import Config
from scanchain.config_keys import ConfigKey, Value, section_keys
from scanchain.settings import flatten, load_settings


class ConfigurationReference(SphinxDirective):
    """A section for each section of the configuration, in its order."""

    has_content = True  # for readers of the source

    def run(self) -> list:
        """Nodes of all sections."""
        presets = {dimension: flatten(load_settings(dimension).config) for dimension in (2, 3)}
        lines = [line for field in fields(Config) for line in _section(field.name, field.type, presets)]
        return self.parse_text_to_nodes("\n".join(lines), allow_section_headings=True)


def _section(name: str, section: type, presets: dict[int, dict[str, Value]]) -> Iterator[str]:
    """Markdown of a section: its docstring's first line, then its keys."""
    yield f"## {name}\n"
    yield f"{(section.__doc__ or '').partition(chr(10))[0].replace('``', '`')}\n"
    for key in section_keys(section):
        yield from _key(key, presets[2][key.name], presets[3][key.name])


def _key(key: ConfigKey, planar: Value, spatial: Value) -> Iterator[str]:
    default = _shown(key, spatial)
    if planar != spatial:
        default = f"{_shown(key, planar)} for 2D logs, {default} for 3D logs"
    text = f"{key.description[:1].upper()}{key.description[1:]}.".replace("``", "`")
    unit = f", in {key.unit}" if key.unit else ""
    yield f"```{{confval}} {key.name}\n{text}\\\n*{escaped(key.range)}{unit}; default {escaped(default)}*\n```\n"


def _shown(key: ConfigKey, value: Value) -> str:
    if isinstance(value, bool):
        return str(value).lower()
    if isinstance(value, str):
        return value or "empty"
    return "no limit" if value == float("inf") else f"{value:g}"


def setup(app: Sphinx) -> dict[str, bool]:
    """Called by Sphinx."""
    app.add_directive("configuration-reference", ConfigurationReference)
    return {"parallel_read_safe": True}
