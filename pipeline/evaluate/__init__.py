"""ATE, RPE, KITTI metric, relations."""
