"""A raw scan made ready for matching: cropped, thinned out, freed of the lidar's own motion."""

from pipeline.preprocess.resolution import Resolution
from pipeline.preprocess.sweep import Sweep, downsample, sweep_of

__all__ = ["Resolution", "Sweep", "downsample", "sweep_of"]
