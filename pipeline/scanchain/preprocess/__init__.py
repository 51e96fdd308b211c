"""Preprocessing of a raw scan: cropping, downsampling, deskewing."""

from scanchain.preprocess.resolution import Prepared, Resolution, prepare, prepare_ahead
from scanchain.preprocess.sweep import Sweep, downsample, sweep_of

__all__ = ["Prepared", "Resolution", "Sweep", "downsample", "prepare", "prepare_ahead", "sweep_of"]
