"""What several tests share: where the real logs lie."""

import os
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]


def shared_data(name: str) -> Path:
    """Path of a real recording, or a skip that says what is missing."""
    folder = Path(os.environ.get("SCANCHAIN_DATA", ROOT.parent / "shared" / "data"))
    path = folder / name
    if not path.exists():
        pytest.skip(f"{path} is absent: real recordings are not part of the project (set SCANCHAIN_DATA)")
    return path
