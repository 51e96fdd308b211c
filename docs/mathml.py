"""Equations as MathML, which browsers typeset themselves: built pages need no script and no network."""

from docutils import nodes
from math_core import LatexError, LatexToMathML
from sphinx.application import Sphinx
from sphinx.errors import ExtensionError
from sphinx.writers.html5 import HTML5Translator

_CONVERTER = LatexToMathML(fancy_error=False)


def inline(self: HTML5Translator, node: nodes.math) -> None:
    """Write an equation within a line."""
    self.body.append(_mathml(node, is_display=False))
    raise nodes.SkipNode


def display(self: HTML5Translator, node: nodes.math_block) -> None:
    """Write an equation of its own lines, which scrolls where it is wider than the page."""
    self.body.append(f'<div class="math">{_mathml(node, is_display=True)}</div>\n')
    raise nodes.SkipNode


def _mathml(node: nodes.Element, *, is_display: bool) -> str:
    try:
        return _CONVERTER.convert_with_local_state(node.astext(), displaystyle=is_display)
    except LatexError as error:
        raise ExtensionError(f"{node.source}:{node.line}: {node.astext()}: {error}") from error


def setup(app: Sphinx) -> dict[str, bool]:
    """Register the renderer ``mathml``."""
    app.add_html_math_renderer("mathml", (inline, None), (display, None))
    return {"parallel_read_safe": True, "parallel_write_safe": True}
