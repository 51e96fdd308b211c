"""What README and docs name exists: modules, configuration keys, files, benchmarks, pages, headings."""

import importlib
import re
import shlex

import click
import pytest

import scanchain
from scanchain.__main__ import scanchain as scanchain_command
from scanchain.settings import config_keys
from tests.docs.test_examples import FENCE, PAGES
from tests.support.scenes import ROOT

KEYS = set(config_keys())
SECTIONS = "|".join(sorted({key.partition(".")[0] for key in KEYS}))


def exists(name):
    """Whether a dotted name can be imported, its last parts as attributes."""
    parts = name.split(".")
    for count in range(len(parts), 0, -1):
        try:
            found = importlib.import_module(".".join(parts[:count]))
        except ModuleNotFoundError:
            continue
        for part in parts[count:]:
            if not hasattr(found, part):
                return False
            found = getattr(found, part)
        return True
    return False


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_every_name_on_the_page_exists(page):
    text = page.read_text(encoding="utf-8")
    assert exists("scanchain.lie.exp") and not exists("scanchain.lie.expo")
    names = [name for name in re.findall(r"`(scanchain(?:\.\w+)+)`", text) if not exists(name)]
    keys = set(re.findall(rf"(?:`|--)((?:{SECTIONS})\.[a-z_]+)(?=[` ])", text)) - KEYS
    keys = {key for key in keys if key.rpartition(".")[2] not in ("mcap", "parquet", "py", "toml", "rrd", "tum")}
    files = [
        file for file in re.findall(r"`((?:pipeline|viz|tests)/[\w/]+\.py)`", text) if not (ROOT / file).exists()
    ]
    benchmarks = [
        name
        for name in re.findall(r"tests\.benchmarks\.(\w+)", text)
        if not (ROOT / f"tests/benchmarks/{name}.py").exists()
    ]
    assert (names, keys, files, benchmarks) == ([], set(), [], [])


def test_every_public_name_is_in_the_reference_of_the_api():
    public = {name for name in dir(scanchain) if not name.startswith("_")}
    assert public == {*scanchain.__all__, "evaluation", "lie"}
    documented = re.findall(r"^\.\. auto\w+:: (\w+)(?:\(.*)?$", (ROOT / "docs/api.md").read_text(), re.MULTILINE)
    assert sorted(documented) == sorted(scanchain.__all__)


def test_every_page_is_in_the_table_of_contents_and_the_readme_is_short():
    listed = re.findall(r"^(\w+)$", (ROOT / "docs/index.md").read_text(), re.MULTILINE)
    assert sorted([*listed, "index"]) == sorted(page.stem for page in PAGES[1:])
    assert len((ROOT / "README.md").read_bytes()) <= 8000


def anchors(page):
    """Anchors of the headings of a page, as GitHub and MyST make them."""
    headings = re.findall(r"^#+ (.*)$", FENCE.sub("", page.read_text(encoding="utf-8")), re.MULTILINE)
    return {re.sub(r"[^\w\- ]", "", heading.lower()).replace(" ", "-") for heading in headings}


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_every_link_has_a_text_and_leads_to_a_file_and_a_heading(page):
    text = FENCE.sub("", page.read_text(encoding="utf-8"))
    for words, path, anchor in re.findall(r"\[([^\]]*)\]\(([^)\s#]*)(?:#([^)\s]+))?[^)]*\)", text):
        target = (page.parent / path) if path else page
        assert words, f"a link to {path} has no text"
        assert "://" in path or target.exists(), path
        assert not anchor or "://" in path or anchor in anchors(target), f"{path}#{anchor}"


def commands_of(text):
    """Words of each ``scanchain`` command, in fences and in lines."""
    for line in re.findall(r"^(?:\$ )?(scanchain [a-z].*)$|`(scanchain\s[a-z][^`]*)`", text, re.MULTILINE):
        yield shlex.split(re.sub(r"\s+", " ", "".join(line)), comments=True)[1:]


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_every_command_and_flag_on_the_page_exists(page):
    text = page.read_text(encoding="utf-8")
    absent = []
    for words in commands_of(text):
        command, names = scanchain_command, list(words)
        while isinstance(command, click.Group) and names and not names[0].startswith("-"):
            command = command.commands.get(names.pop(0).rstrip(":,"))
        known = {option for each in command.params for option in each.opts} if command else set()
        flags = (
            {word.partition("=")[0] for word in names if word.startswith("--")} - known - {"--help", "--version"}
        )
        absent += [(words, flag) for flag in flags if flag.removeprefix("--") not in KEYS] if command else [words]
    assert absent == []
