"""A real Chromium without a window: what a page looks like once it is laid out."""

import html
import json
import re
import shutil
import subprocess

import pytest

NAMES = ("chromium", "chromium-browser", "google-chrome", "google-chrome-stable")
_NARROWEST = 500  # pixels of Chromium's window
_PROBE = """
<script>
const texts = [...document.querySelectorAll("figure > svg")].filter(svg => svg.clientWidth).map(svg => {
  const frame = svg.getBoundingClientRect();
  const boxes = [...svg.querySelectorAll("text")].map(t => [t.textContent, t.getBoundingClientRect()]);
  const cut = boxes.filter(([, b]) => b.left < frame.left - 1 || b.right > frame.right + 1 ||
                                      b.top < frame.top - 1 || b.bottom > frame.bottom + 1).map(([t]) => t);
  const overlapping = [];
  boxes.forEach(([t, a], i) => boxes.slice(i + 1).forEach(([u, b]) => {
    const width = Math.min(a.right, b.right) - Math.max(a.left, b.left);
    const height = Math.min(a.bottom, b.bottom) - Math.max(a.top, b.top);
    if (width > 1 && height > 3) overlapping.push(t + " | " + u);
  }));
  const letters = Math.min(...boxes.map(([, b]) => Math.min(b.width, b.height)).filter(size => size > 0));
  return {width: frame.width, height: frame.height, letters, cut, overlapping};
});
const scrolled = [...document.querySelectorAll("figure")].filter(f => f.scrollWidth > f.clientWidth + 1).length;
const outside = [...document.querySelectorAll("main *")].filter(e => !e.closest(".scroll, svg") &&
  e.getBoundingClientRect().right > document.documentElement.clientWidth + 1).map(e => e.tagName);
window.parent.document.title = "PROBE" + JSON.stringify({
  svgs: texts, outside, scrolled, scripts: document.scripts.length, wide: document.documentElement.scrollWidth,
  width: document.documentElement.clientWidth, paper: getComputedStyle(document.body).backgroundColor,
  tables: document.querySelectorAll("table").length, rows: document.querySelectorAll("table tbody tr").length,
  names: Math.max(0, ...[...document.querySelectorAll("tbody th")].map(e => e.getBoundingClientRect().width)),
  reasons: Math.max(0, ...[...document.querySelectorAll("td.wide span")].map(
    e => e.getBoundingClientRect().right)),
  text: document.body.innerText, bold: document.querySelectorAll("td.best").length });
</script>
"""


def find_browser():
    """Its path, or a skip that says what is missing."""
    path = next(filter(None, map(shutil.which, NAMES)), None)
    if path is None:
        pytest.skip("no Chromium here (apt-get install chromium): the page is not looked at in a real browser")
    return path


def look(page, folder, *, width, dark=False):
    """What a page, opened from disk, is like at this width: a dict of the probe above."""
    probed = re.sub(r'<meta http-equiv="Content-Security-Policy"[^>]*>', "", page.read_text(encoding="utf-8"))
    probed = probed.replace("</body>", f"{_PROBE}</body>")
    if width < _NARROWEST:  # a window cannot be that narrow, a frame can
        frame = f'<iframe srcdoc="{html.escape(probed)}" style="width: {width}px; height: 1900px; border: 0">'
        probed = f"<!doctype html><title></title><body>{frame}</iframe></body>"
    (folder / "page.html").write_text(probed, encoding="utf-8")
    scheme = 0 if dark else 1
    command = [
        find_browser(), "--headless", "--no-sandbox", "--disable-gpu", f"--user-data-dir={folder / 'profile'}",
        f"--blink-settings=preferredColorScheme={scheme}", f"--window-size={width},2000", "--dump-dom",
        f"file://{folder / 'page.html'}",
    ]  # fmt: skip
    answer = subprocess.run(command, capture_output=True, text=True, timeout=120, check=False)
    found = re.search(r"<title>PROBE(.*?)</title>", answer.stdout, re.DOTALL)
    assert found, answer.stderr[-2000:]
    return json.loads(html.unescape(found[1]))
