"""A map for nav2: the occupancy grid of a run, and the map of the same run to localize in later."""

import numpy as np
from PIL import Image

import scanchain

scanchain.simulate("office", "office.mcap", duration_s=20.0)
done = scanchain.run("office.mcap", "runs/office", recording=False, maps__grid_resolution_m=0.05)
print(done.metrics.verdict)  # -> trustworthy
print(
    (done.path / "map.yaml").read_text()
)  # -> image: map.pgm mode: trinary resolution: 0.05 origin: [-5.35, -5.1, 0] ...

# ros2 run nav2_map_server map_server --ros-args -p yaml_filename:=runs/office/map.yaml
pixels = np.asarray(Image.open(done.path / "map.pgm"))
free, occupied = (pixels == 254).sum(), (pixels == 0).sum()
print(pixels.shape, free > 10 * occupied > 0)  # -> (362, 442) True

localizer = scanchain.Localizer("runs/office", initial=np.eye(3))  # poses in the frame of the grid
placed = [localizer.process(scan) for scan in scanchain.open_log("office.mcap", end_s=3.0)]
print(placed[-1].state)  # -> localized
