"""A module is tested by the file that is named after it, as CONTRIBUTING says."""

import re

import pytest

from tests.support.scenes import ROOT


@pytest.mark.parametrize("room", ["graph", "loops", "odometry", "registration", "sessions", "verdict"])
def test_every_module_has_a_file_of_tests_that_imports_from_it(room):
    modules = sorted(path.stem for path in (ROOT / "pipeline/scanchain" / room).glob("[!_]*.py"))
    files = {name: ROOT / "tests" / room / f"test_{name}.py" for name in modules}
    texts = {name: file.read_text() if file.exists() else "" for name, file in files.items()}
    untested = [
        name for name, text in texts.items() if not re.search(rf"scanchain\.{room}(\.{name})? import", text)
    ]
    assert modules and untested == []
