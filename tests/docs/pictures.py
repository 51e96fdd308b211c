"""Pictures of README and docs, drawn by the commands of their captions.

    python -m tests.docs.pictures [NAME ...]

Names are those of the files in docs/pictures, without ending; all without any. vouching_roc takes 45
minutes. Real logs come from ../shared/data (or SCANCHAIN_DATA); a picture whose log is absent is left as it is,
and named. Pages and the rerun viewer, which draws by WebGL, are taken in a Chromium without a window.
"""

from __future__ import annotations

import json
import re
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Callable
from functools import partial
from http.server import SimpleHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from urllib.parse import quote

from PIL import Image, ImageChops

from scanchain_viz.recording.viewer import start_web, stop, web_address
from tests.support.browser import find_browser
from tests.support.scenes import DATA, ROOT

FOLDER = ROOT / "docs" / "pictures"
WIDTH, BESIDE_WIDTH = 1000, 750  # px, of a picture alone and of each of those beside each other
NARROW = "--preprocess.max_range_m 4"
WITHOUT_WHEELS = f"run identical.mcap --out without_wheels {NARROW} --odometry.prior constant-velocity"
PANDASET = f"{DATA}/3d/pandaset_002_sweeps30to55.mcap"
THREADS = "threads --scans 16 --log kitti_0005_first60.mcap kitti_0001_first54.mcap"
LOADING_S = 90.0  # of a recording, and playing, in a viewer that draws in software
PADDING = 20  # px around a part of a page

Drawing = Callable[[Path], Image.Image]


def runs(*names: str) -> Drawing:
    """Finished runs, beside each other, as ``scanchain view --png`` draws them."""

    def draw(folder: Path) -> Image.Image:
        images = []
        for name in names:
            scanchain(f"view {name} --png {name}.png", folder, check=True)
            images.append(Image.open(folder / f"{name}.png").convert("RGB"))
        width = WIDTH if len(images) == 1 else BESIDE_WIDTH
        scaled = [
            each.resize((width, round(each.height * width / each.width)), Image.Resampling.LANCZOS)
            for each in images
        ]
        whole = Image.new("RGB", (width * len(scaled), max(image.height for image in scaled)), "white")
        for place, image in enumerate(scaled):
            whole.paste(image, (place * width, 0))
        palette = whole.quantize(256, Image.Quantize.MAXCOVERAGE, kmeans=10)  # with the colors of thin lines
        flat = whole.quantize(palette=palette, dither=Image.Dither.NONE)
        flat.putpalette([255 if shade > 246 else shade for shade in flat.getpalette()])  # means of white
        return flat

    return draw


def page(path: str, style: str, *, keys: str = "", size: tuple[int, int] = (1060, 1400)) -> Drawing:
    """What is left of a page under more style, after keys that its map answers."""

    def draw(folder: Path) -> Image.Image:
        text = re.sub('<meta http-equiv="Content-Security-Policy"[^>]*>', "", (folder / path).read_text("utf-8"))
        press = f"""<script>for (const key of {json.dumps(keys.split())})
          document.querySelector("canvas.scene").dispatchEvent(new KeyboardEvent("keydown", {{key}}));</script>"""
        text = text.replace("</head>", f"<style>{style}</style></head>")
        (folder / "page.html").write_text(text.replace("</body>", f"{press}</body>"), "utf-8")
        image = screenshot(f"file://{folder / 'page.html'}", folder, size, "--virtual-time-budget=5000")
        left, top, right, bottom = ImageChops.difference(image, Image.new("RGB", image.size, "white")).getbbox()
        left, top = max(left - PADDING, 0), max(top - PADDING, 0)
        return image.crop((left, top, min(right + PADDING, image.width), min(bottom + PADDING, image.height)))

    return draw


def benchmark(words: str) -> Drawing:
    """What a benchmark draws by ``--png``."""

    def draw(folder: Path) -> Image.Image:
        command = [sys.executable, "-m", f"tests.benchmarks.{words.split()[0]}", *words.split()[1:]]
        subprocess.run([*command, "--png", str(folder / "drawn.png")], cwd=ROOT, check=True)
        return Image.open(folder / "drawn.png").convert("RGB")

    return draw


def recording(path: str) -> Drawing:
    """A recording that plays in the web viewer.

    A screenshot is taken when the page is loaded: a picture in it takes as long as the viewer does.
    """

    class Handler(SimpleHTTPRequestHandler):
        def do_GET(self) -> None:
            if self.path == "/late":
                time.sleep(LOADING_S)
            super().do_GET()

        def end_headers(self) -> None:
            self.send_header("Access-Control-Allow-Origin", "*")
            super().end_headers()

        def log_message(self, format: str, *args: object) -> None:
            """Nothing is printed of requests."""

    def draw(folder: Path) -> Image.Image:
        server = ThreadingHTTPServer(("127.0.0.1", 0), partial(Handler, directory=str(folder)))
        threading.Thread(target=server.serve_forever, daemon=True).start()
        here, viewer = f"http://127.0.0.1:{server.server_port}", start_web()
        address = f"{web_address().partition('?')[0]}?url={quote(f'{here}/{path}', safe='')}"
        frame = f'<iframe src="{address}" style="border: 0; width: 1600px; height: 900px"></iframe>'
        (folder / "viewer.html").write_text(f'<body style="margin: 0">{frame}<img src="/late"></body>', "utf-8")
        time.sleep(5.0)
        try:
            flags = ("--use-angle=swiftshader", "--enable-unsafe-swiftshader", "--ignore-gpu-blocklist")
            dark = "--blink-settings=preferredColorScheme=0"
            return screenshot(f"{here}/viewer.html", folder, (1600, 900), *flags, dark)
        finally:
            stop(viewer)
            server.shutdown()

    return draw


SECOND_SECTION = "main > :not(section:nth-of-type(2)) { display: none; } h2 { margin-top: 0; }"
ONLY_MAP = """main > :not(section:nth-of-type(2)), figure:not(:has(canvas)), figcaption, .buttons, .chips, h2, h3
{ display: none; } main, figure { padding: 0; border: 0; max-width: none; }
canvas.scene { height: 520px; margin: 0; border-radius: 0; }"""
TOP = "section ~ section, h2:has(~ details), details { display: none; }"
PICTURES: dict[str, tuple[tuple[str, ...], Drawing]] = {  # commands, and what is drawn after them
    "run": (("simulate office office.mcap --duration 120", "run office.mcap --out office"), runs("office")),
    "doubled": (
        ("simulate identical identical.mcap", WITHOUT_WHEELS, f"run identical.mcap --out with_wheels {NARROW}"),
        runs("without_wheels", "with_wheels"),
    ),
    "report": (
        ("simulate identical identical.mcap", WITHOUT_WHEELS),
        page("without_wheels/report.html", SECOND_SECTION),
    ),
    "intel": ((f"run {DATA}/2d/intel.mcap --out intel",), runs("intel")),
    "mit_csail": ((f"run {DATA}/2d/mit_csail.mcap --out mit_csail",), runs("mit_csail")),
    "pandaset": (
        (f"run {PANDASET} --topic /pandar64/points --out pandaset",),
        page("pandaset/report.html", ONLY_MAP, keys="ArrowRight " * 14 + "+ " * 5 + "ArrowDown", size=(1200, 520)),
    ),
    "comparison": (
        (
            "simulate office office.mcap --duration 40",
            "compare office.mcap --methods plicp,plicp+loops,svd,kiss-icp,small-gicp --out compared",
        ),
        page("compared/report.html", TOP),
    ),
    "viewer": (
        ("sequence get demo-town --out logs", "run logs/demo-town.mcap --out town"),
        recording("town/recording.rrd"),
    ),
    "threads": ((), benchmark(THREADS)),
    "vouching_roc": ((), benchmark("vouching --jobs 2")),
}


def scanchain(words: str, folder: Path, *, check: bool = False) -> None:
    """Run a command in a folder."""
    subprocess.run([sys.executable, "-m", "scanchain", *words.split()], cwd=folder, check=check)


def screenshot(address: str, folder: Path, size: tuple[int, int], *flags: str) -> Image.Image:
    """A page in a browser window of this size."""
    profile, window = f"--user-data-dir={folder / 'profile'}", f"--window-size={size[0]},{size[1]}"
    common = (
        "--headless",
        "--no-sandbox",
        "--hide-scrollbars",
        profile,
        window,
        f"--screenshot={folder}/shot.png",
    )
    subprocess.run([find_browser(), *common, *flags, address], capture_output=True, check=True, timeout=300)
    return Image.open(folder / "shot.png").convert("RGB")


def main() -> None:
    for name in sys.argv[1:] or PICTURES:
        commands, draw = PICTURES[name]
        absent = [
            word for word in " ".join(commands).split() if word.startswith(str(DATA)) and not Path(word).exists()
        ]
        if absent:
            print(f"{name} is left as it is: {absent[0]} is absent")
            continue
        with tempfile.TemporaryDirectory() as folder:
            for command in commands:
                scanchain(command, Path(folder))  # a verdict that is none to rely on is what some of them show
            ending, options = ("jpg", {"quality": 82}) if name == "viewer" else ("png", {})
            draw(Path(folder)).save(FOLDER / f"{name}.{ending}", optimize=True, **options)


if __name__ == "__main__":
    main()
