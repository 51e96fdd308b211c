"""Pictures of README and docs, drawn by the commands of their captions.

    python -m tests.docs.pictures [NAME ...]

Names are those of the files in docs/pictures, without ending; all of ``PICTURES`` without any. Real logs come from
../shared/data (or SCANCHAIN_DATA); a picture whose log is absent is left as it is, and named. Of the others,
threads.png and vouching_roc.png are made by ``--png`` of their benchmarks, report.png and comparison.png are parts
of the reports of their captions in a browser, viewer.jpg is a view of the rerun viewer.
"""

from __future__ import annotations

import os
import subprocess
import sys
import tempfile
from pathlib import Path

from PIL import Image

from tests.benchmarks.harness import DATA
from tests.support.scenes import ROOT

FOLDER = ROOT / "docs" / "pictures"
WIDTH, BESIDE_WIDTH = 1000, 750  # px, of a picture alone and of each of those beside each other
NEARLY_WHITE = 248
NARROW = "--preprocess.max_range_m 4"
PICTURES = {  # for each picture the commands, and the pictures drawn by them that stand beside each other in it
    "run": (
        (
            "simulate office office.mcap --duration 120",
            "run office.mcap --out office --rerun off",
            "view office --png office.png",
        ),
        ("office.png",),
    ),
    "doubled": (
        (
            "simulate identical identical.mcap",
            f"run identical.mcap --out without_wheels {NARROW} --odometry.prior constant-velocity --rerun off",
            "view without_wheels --png without_wheels.png",
            f"run identical.mcap --out with_wheels {NARROW} --rerun off",
            "view with_wheels --png with_wheels.png",
        ),
        ("without_wheels.png", "with_wheels.png"),
    ),
    "intel": (
        (f"run {DATA}/2d/intel.mcap --out intel --rerun off", "view intel --png intel.png"),
        ("intel.png",),
    ),
    "mit_csail": (
        (f"run {DATA}/2d/mit_csail.mcap --out mit_csail --rerun off", "view mit_csail --png mit_csail.png"),
        ("mit_csail.png",),
    ),
}


def draw(name: str, folder: Path) -> None:
    """Write a picture; a verdict that is none to rely on is what some of them show."""
    commands, drawn = PICTURES[name]
    for command in commands:
        words = [sys.executable, "-m", "scanchain", *command.split()]
        done = subprocess.run(words, cwd=folder, capture_output=True)
        if done.returncode and not command.startswith("run "):
            sys.exit(f"{command}: {done.stderr.decode()}")
    images = [Image.open(folder / file).convert("RGB") for file in drawn]
    width = WIDTH if len(images) == 1 else BESIDE_WIDTH
    for place, image in enumerate(images):
        images[place] = image.resize((width, round(image.height * width / image.width)), Image.Resampling.LANCZOS)
    whole = Image.new("RGB", (width * len(images), max(image.height for image in images)), "white")
    for place, image in enumerate(images):
        whole.paste(image, (place * width, 0))
    # Colors of thin lines as well, then moved to the frequent ones.
    palette = whole.quantize(256, Image.Quantize.MAXCOVERAGE, kmeans=10)
    flat = whole.quantize(palette=palette, dither=Image.Dither.NONE)
    colors = flat.getpalette() or []
    entries = [colors[at : at + 3] for at in range(0, len(colors), 3)]
    flat.putpalette([value for each in entries for value in ([255] * 3 if min(each) >= NEARLY_WHITE else each)])
    flat.save(FOLDER / f"{name}.png", optimize=True)
    print(f"{name}.png, {os.path.getsize(FOLDER / f'{name}.png') // 1024} kB", flush=True)


def main() -> None:
    for name in sys.argv[1:] or PICTURES:
        absent = [word for word in " ".join(PICTURES[name][0]).split() if word.startswith(str(DATA))]
        if absent and not Path(absent[0]).exists():
            print(f"{name}.png is left as it is: {absent[0]} is absent")
            continue
        with tempfile.TemporaryDirectory() as folder:
            draw(name, Path(folder))


if __name__ == "__main__":
    main()
