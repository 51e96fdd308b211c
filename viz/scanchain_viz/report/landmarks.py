"""Pictures of landmark problems and one page that holds them, with nothing outside itself."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np

from scanchain.errors import InputError
from scanchain.landmarks.results import accuracy_lines, file_stem, size_of, table_of
from scanchain.landmarks.study import Study
from scanchain_viz.pictures.problems import (
    AFTER,
    BEFORE,
    draw_estimate,
    draw_factors,
    plot_after,
    plot_before,
    plot_factor,
)  # fmt: skip
from scanchain_viz.report import page

_TIMES = (
    "Times are medians; each method solves from scratch with what it needs to know about the pattern (again: with "
    "that kept)."
)
_DIFFERS = "Differs by is the largest difference of an unknown from the first method."
_PINV = "Entries of (AᵀA)⁻¹ stand for the factor that pinv does not have."


def write_report(directory: Path, studies: Sequence[Study]) -> None:
    """Write a PNG of every estimate and of the factors, and report.html.

    With several problems their factors stand side by side in one more picture.
    """
    try:
        for study in studies:
            draw_estimate(directory / f"{file_stem(study.name)}.png", study)
            draw_factors(directory / f"{file_stem(study.name)}_factors.png", [study])
        if len(studies) > 1:
            draw_factors(directory / "factors.png", studies)
        sections = tuple(each for study in studies for each in _sections(study))
        title = f"Landmark problem{'s' if len(studies) > 1 else ''}"
        names = ", ".join(study.name for study in studies)
        definitions = dict.fromkeys(study.after.definition for study in studies)
        fold = page.Collapsible("Definition of the errors", "\n\n".join(definitions))
        page.write_page(directory / page.REPORT_FILE, page.Page(title, names, (), (), (), sections, (fold,)))
    except OSError as error:
        raise InputError(f"{directory}: not writable ({error.strerror}); choose another --out") from error


def _sections(study: Study) -> Iterator[page.Section]:
    """The estimate, then the linear solvers."""
    (_, before), (_, after), _ = accuracy_lines(study)
    facts = (
        ("error before, rmse", before),
        ("error after, rmse", after),
        *((fact.label, fact.value) for fact in study.facts),
    )
    is_known = bool(len(study.true_poses) or np.isfinite(study.true_landmarks).any())
    truth = (page.Chip("truth", "var(--ink)", is_dashed=True),) if is_known else ()
    chips = (page.Chip("before", BEFORE), page.Chip("after", AFTER), *truth)
    marks = "Circles: landmarks" + ("; crosses: true ones" if is_known else "")
    drawings = (
        page.Drawing("Before optimization", f"{marks}.", plot_before(study).svg()),
        page.Drawing("After optimization", f"{marks}; ellipses: 95 %.", plot_after(study).svg()),
    )
    yield page.Section(study.name, facts=facts, chips=chips, drawings=drawings)
    factors = tuple(
        page.Drawing(f"{method.method}: {method.factor.name}", "", plot_factor(method).svg())
        for method in study.methods
    )
    text = f"The Jacobian A has {size_of(study)}. Drawn is where the factor of every method is not zero."
    yield page.Section(f"Linear solvers on {study.name}", text, grid=_grid(study), drawings=factors, is_small=True)


def _grid(study: Study) -> page.Grid:
    headings, *rows = table_of(study)
    split = [heading.partition(" ms") for heading in headings]
    heads = tuple(page.Head(name, unit.strip()) for name, unit, _ in split)
    notes = (_TIMES, *((_DIFFERS, _PINV) if len(rows) > 1 else ("--methods all compares the linear solvers.",)))
    return page.Grid(heads, tuple(page.Row(name, tuple(cells)) for name, *cells in rows), notes)
