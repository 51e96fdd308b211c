"""Pictures of README and docs, drawn by the commands of their captions.

    python -m tests.docs.pictures [NAME ...]

Names are those of the files in docs/pictures, without ending; all of ``PICTURES`` without any. Real logs come from
../shared/data (or SCANCHAIN_DATA); a picture whose log is absent is left as it is, and named. Of the others,
threads.png and vouching_roc.png are made by ``--png`` of their benchmarks, report.png and comparison.png are parts
of the reports of their captions in a browser, viewer.jpg is a view of the rerun viewer.
"""

from __future__ import annotations

import subprocess
import sys
import tempfile
from pathlib import Path

from PIL import Image

from tests.support.scenes import DATA, ROOT

FOLDER = ROOT / "docs" / "pictures"
WIDTH, BESIDE_WIDTH = 1000, 750  # px, of a picture alone and of each of those beside each other
NARROW = "--preprocess.max_range_m 4"
PICTURES = {  # for each picture the commands; the runs by them stand beside each other in it
    "run": ("simulate office office.mcap --duration 120", "run office.mcap --out office"),
    "doubled": (
        "simulate identical identical.mcap",
        f"run identical.mcap --out without_wheels {NARROW} --odometry.prior constant-velocity",
        f"run identical.mcap --out with_wheels {NARROW}",
    ),
    "intel": (f"run {DATA}/2d/intel.mcap --out intel",),
    "mit_csail": (f"run {DATA}/2d/mit_csail.mcap --out mit_csail",),
}


def draw(name: str, folder: Path) -> None:
    """Write a picture; a verdict that is none to rely on is what some of them show."""
    images = []
    for command in PICTURES[name]:
        subprocess.run([sys.executable, "-m", "scanchain", *command.split()], cwd=folder)
        if command.startswith("run "):
            run = command.split()[3]
            view = [sys.executable, "-m", "scanchain", "view", run, "--png", f"{run}.png"]
            subprocess.run(view, cwd=folder, check=True)
            images.append(Image.open(folder / f"{run}.png").convert("RGB"))
    width = WIDTH if len(images) == 1 else BESIDE_WIDTH
    for place, image in enumerate(images):
        images[place] = image.resize((width, round(image.height * width / image.width)), Image.Resampling.LANCZOS)
    whole = Image.new("RGB", (width * len(images), max(image.height for image in images)), "white")
    for place, image in enumerate(images):
        whole.paste(image, (place * width, 0))
    palette = whole.quantize(256, Image.Quantize.MAXCOVERAGE, kmeans=10)  # with the colors of thin lines
    flat = whole.quantize(palette=palette, dither=Image.Dither.NONE)
    flat.save(FOLDER / f"{name}.png", optimize=True)


def main() -> None:
    for name in sys.argv[1:] or PICTURES:
        absent = [word for word in " ".join(PICTURES[name]).split() if word.startswith(str(DATA))]
        if absent and not Path(absent[0]).exists():
            print(f"{name}.png is left as it is: {absent[0]} is absent")
            continue
        with tempfile.TemporaryDirectory() as folder:
            draw(name, Path(folder))


if __name__ == "__main__":
    main()
