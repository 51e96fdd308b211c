"""``--gt``: a file or a topic."""

from __future__ import annotations

from pathlib import Path

from pipeline.settings import Override


def ground_truth(text: str | None) -> tuple[Path | None, tuple[Override, ...]]:
    """A file, or a topic as an override; what is neither a file nor looks like a topic is taken for a file."""
    if text is None:
        return None, ()
    path = Path(text)
    if text.startswith("/") and not path.exists() and not path.suffix:
        return None, (Override("log.ground_truth_topic", text, "--gt"),)
    return path, ()
