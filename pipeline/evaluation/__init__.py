"""Metrics of a trajectory: ATE, RPE, the KITTI metric, relations, sharpness; each with its definition."""

from scanchain.evaluation.absolute import (
    AbsoluteError,
    Alignment,
    absolute_error,
    absolute_error_of_any_path,
    align,
    far_off,
    on_the_estimate,
)
from scanchain.evaluation.consistency import disagreement, motion_nees
from scanchain.evaluation.expected import ExpectedError, ExpectedErrors, expected_ate, expected_errors
from scanchain.evaluation.pairing import Pairs, Statistics, during, pair
from scanchain.evaluation.reference import TruthFile, check_overlap, read_truth
from scanchain.evaluation.relations import (
    RELATION_LIMIT_S,
    RelationError,
    Relations,
    read_relations,
    relation_error,
)
from scanchain.evaluation.relative import (
    KITTI_LENGTHS_M,
    SHORT_LENGTHS_M,
    KittiError,
    LengthError,
    RelativeError,
    kitti_error,
    kitti_error_of_any_path,
    relative_error_over_distance,
    relative_error_over_frames,
    relative_error_over_time,
)
from scanchain.evaluation.sharpness import Sharpness, sampled_map, sampling_step, sharpness

__all__ = [
    "KITTI_LENGTHS_M",
    "RELATION_LIMIT_S",
    "SHORT_LENGTHS_M",
    "AbsoluteError",
    "Alignment",
    "ExpectedError",
    "ExpectedErrors",
    "KittiError",
    "LengthError",
    "Pairs",
    "RelationError",
    "Relations",
    "RelativeError",
    "Sharpness",
    "Statistics",
    "TruthFile",
    "absolute_error",
    "absolute_error_of_any_path",
    "align",
    "check_overlap",
    "disagreement",
    "during",
    "expected_ate",
    "expected_errors",
    "far_off",
    "kitti_error",
    "kitti_error_of_any_path",
    "motion_nees",
    "on_the_estimate",
    "pair",
    "read_relations",
    "read_truth",
    "relation_error",
    "relative_error_over_distance",
    "relative_error_over_frames",
    "relative_error_over_time",
    "sampled_map",
    "sampling_step",
    "sharpness",
]
