"""What messages must say."""

import re


def unfolded(text: str) -> str:
    """Text whose lines were folded, the indented continuations joined again."""
    return re.sub(r"\n {2,}", " ", text)


def says(text, *parts):
    missing = [str(part) for part in parts if str(part) not in text]
    assert not missing, f"{missing} not in: {text}"
