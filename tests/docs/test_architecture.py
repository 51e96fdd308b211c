"""docs/architecture.md says what the contract says, and its picture shows the imports there are."""

import re

from tests.docs import architecture
from tests.support.scenes import ROOT

PAGE = (ROOT / "docs" / "architecture.md").read_text()


def test_the_table_of_layers_is_the_contract():
    table = PAGE[PAGE.index("| row | |") : PAGE.index("## The path of a scan")]
    rows = [re.findall(r"`(\w+)`", line.split("|")[1]) for line in table.splitlines() if line.startswith("| `")]
    assert rows == architecture.layers()


def test_the_picture_shows_the_imports_there_are(tmp_path):
    architecture.main(tmp_path / "now.svg")
    drawn, now = (
        re.findall(r"<text[^>]*>[^<]*", path.read_text()) for path in (architecture.FILE, tmp_path / "now.svg")
    )
    lines, now_lines = (path.read_text().count("<path d=") for path in (architecture.FILE, tmp_path / "now.svg"))
    assert (drawn, lines) == (now, now_lines), "draw it again: python -m tests.docs.architecture"


def test_every_file_it_names_exists():
    names = re.findall(r"\]\((\.\./[^)#]+)\)", PAGE)
    assert len(names) > 40 and all((ROOT / "docs" / name).is_file() for name in names)
