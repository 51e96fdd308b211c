"""Words of the house that the field does not know: none of them comes back."""

import io
import re
import tokenize
from functools import cache
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]
WORDS = {
    "in vain": "without result",
    "from which on": "above which, first ... where",
    "sought": "searched",
    "speaks? (for|against)": "supports, contradicts",
    "feigns?": "noise-induced",
    "witness(es)?": "show",
    "thinned out": "downsampled",
    "given up": "rejected",
    "taken (up|back)": "resumed, withdrawn",
    "freed of": "deskewed",
    "mended": "repaired, refined",
    "partners?": "correspondences",
    "vouch(es)? for": "error estimate",
    "likeness": "similarity",
    "gallery": "descriptor database",
    "looks? alike|look-alike": "perceptually aliased",
    "as known at": "as estimated at",
    "milliseconds a scan": "ms per scan",
    "with 95 %": "95 % interval",
    "(check|several|these) stretch(es)?": "segments",
}


def prose(file):
    """Comments and texts of a Python file, a whole file of Markdown, by line."""
    text = file.read_text(encoding="utf-8")
    if file.suffix == ".md":
        yield from enumerate(text.splitlines(), 1)
        return
    for token in tokenize.generate_tokens(io.StringIO(text).readline):
        if token.type in (tokenize.COMMENT, tokenize.STRING):
            yield from enumerate(token.string.splitlines(), token.start[0])


@cache
def lines():
    """All of it: where, and what stands there."""
    return [(f"{file.relative_to(ROOT)}:{line}", text) for file in FILES for line, text in prose(file)]


FILES = [
    *sorted(ROOT.glob("pipeline/**/*.py")),
    *sorted(ROOT.glob("viz/**/*.py")),
    *sorted(ROOT.glob("docs/*.md")),
    *(ROOT / name for name in ("README.md", "CONTRIBUTING.md", "CHANGELOG.md")),
]


@pytest.mark.parametrize("word", WORDS)
def test_it_is_said_in_the_words_of_the_field(word):
    pattern = re.compile(rf"\b({word})\b", re.IGNORECASE)
    found = [where for where, text in lines() if pattern.search(text)]
    assert not found, f"{word!r}: say {WORDS[word]!r} in {', '.join(found[:10])}"
