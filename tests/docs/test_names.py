"""What README and docs name exists: modules, configuration keys, files of the repository, benchmarks."""

import importlib
import re

import pytest

from scanchain.settings import config_keys
from tests.support.scenes import ROOT

PAGES = [ROOT / "README.md", *sorted((ROOT / "docs").glob("*.md"))]
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


def test_a_name_that_is_gone_is_noticed():
    assert exists("scanchain.lie.exp")
    assert not exists("scanchain.lie.expo")
    assert not exists("scanchain.lies")


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_every_name_on_the_page_exists(page):
    text = page.read_text(encoding="utf-8")
    names = [name for name in re.findall(r"`(scanchain(?:\.\w+)+)`", text) if not exists(name)]
    keys = set(re.findall(rf"(?:`|--)((?:{SECTIONS})\.[a-z_]+)(?=[` ])", text)) - KEYS
    keys = {key for key in keys if key.rpartition(".")[2] not in ("mcap", "parquet", "toml", "rrd", "tum")}
    files = [
        file for file in re.findall(r"`((?:pipeline|viz|tests)/[\w/]+\.py)`", text) if not (ROOT / file).exists()
    ]
    benchmarks = [
        name
        for name in re.findall(r"tests\.benchmarks\.(\w+)", text)
        if not (ROOT / f"tests/benchmarks/{name}.py").exists()
    ]
    assert (names, keys, files, benchmarks) == ([], set(), [], [])
