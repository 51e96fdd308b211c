"""A raw scan made ready for matching: cropped, thinned out, freed of the lidar's own motion."""

from scanchain.preprocess.resolution import Resolution
from scanchain.preprocess.sweep import Sweep, downsample, sweep_of

__all__ = ["Resolution", "Sweep", "downsample", "sweep_of"]
