"""How good a trajectory is: ATE, RPE, the KITTI metric, relations, sharpness; each says what it measures."""

from pipeline.evaluate.absolute import (
    AbsoluteError,
    absolute_error,
    absolute_error_on_any_course,
    on_the_estimate,
)
from pipeline.evaluate.alignment import Alignment, align
from pipeline.evaluate.consistency import motion_nees
from pipeline.evaluate.disagreement import disagreement
from pipeline.evaluate.kitti import (
    KITTI_LENGTHS_M,
    SHORT_LENGTHS_M,
    KittiError,
    LengthError,
    kitti_error,
    kitti_error_on_any_course,
)
from pipeline.evaluate.pairing import Pairs, during, pair
from pipeline.evaluate.reference import TruthFile, check_overlap, read_truth
from pipeline.evaluate.relations import (
    RELATION_LIMIT_S,
    RelationError,
    Relations,
    read_relations,
    relation_error,
)
from pipeline.evaluate.relative import (
    RelativeError,
    relative_error_over_distance,
    relative_error_over_frames,
    relative_error_over_time,
)
from pipeline.evaluate.sharpness import Sharpness, sampled_map, sampling_step, sharpness
from pipeline.evaluate.statistics import Statistics

__all__ = [
    "KITTI_LENGTHS_M",
    "RELATION_LIMIT_S",
    "SHORT_LENGTHS_M",
    "AbsoluteError",
    "Alignment",
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
    "absolute_error_on_any_course",
    "align",
    "check_overlap",
    "disagreement",
    "during",
    "kitti_error",
    "kitti_error_on_any_course",
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
