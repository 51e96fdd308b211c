"""Pictures of landmark problems and one page that holds them, with nothing outside itself."""

from __future__ import annotations

from base64 import b64encode
from collections.abc import Sequence
from pathlib import Path

from scanchain.errors import InputError
from scanchain.landmarks.files.write import accuracy_lines, file_stem, size_of, table_of
from scanchain.landmarks.study import Study
from scanchain.viz.pictures.landmarks import draw_estimate, draw_factors
from scanchain.whole_file import write_whole

_PAGE = "report.html"


def write_report(directory: Path, studies: Sequence[Study]) -> None:
    """Write a PNG of every estimate and of the factors, and report.html.

    With several problems their factors stand side by side in one more picture.
    """
    from jinja2 import Environment, FileSystemLoader, StrictUndefined

    environment = Environment(
        loader=FileSystemLoader(Path(__file__).parent / "templates"),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    try:
        problems = [_problem(directory, study) for study in studies]
        together = ""
        if len(studies) > 1:
            draw_factors(directory / "factors.png", studies)
            together = _inline(directory / "factors.png")
        page = environment.get_template("landmarks.html").render(problems=problems, together=together)
        write_whole(directory / _PAGE, page.encode())
    except OSError as error:
        raise InputError(f"{directory}: not writable ({error.strerror}); choose another --out") from error


def _problem(directory: Path, study: Study) -> dict[str, object]:
    """Pictures and figures of one problem for the page."""
    stem = file_stem(study.name)
    estimate, factors = directory / f"{stem}.png", directory / f"{stem}_factors.png"
    draw_estimate(estimate, study)
    draw_factors(factors, [study])
    facts = [(fact.label, fact.value) for fact in study.facts]
    return {
        "name": study.name,
        "facts": [*facts, *accuracy_lines(study), ("A", size_of(study))],
        "table": table_of(study),
        "is_comparison": len(study.methods) > 1,
        "estimate": _inline(estimate),
        "factors": _inline(factors),
    }


def _inline(picture: Path) -> str:
    """A PNG as the address of itself."""
    return f"data:image/png;base64,{b64encode(picture.read_bytes()).decode('ascii')}"
