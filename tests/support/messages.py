"""What messages must say."""


def says(text, *parts):
    missing = [str(part) for part in parts if str(part) not in text]
    assert not missing, f"{missing} not in: {text}"
