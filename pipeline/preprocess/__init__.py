"""Preprocessing of a raw scan: cropping, downsampling, deskewing."""

from scanchain.preprocess.resolution import Resolution
from scanchain.preprocess.sweep import Sweep, downsample, sweep_of

__all__ = ["Resolution", "Sweep", "downsample", "sweep_of"]
