"""Types, errors and small helpers that every package of merl may import."""

from merl.core.errors import (
    CallbackFailed,
    EnvironmentFailed,
    EnvironmentsLost,
    EvaluationFailed,
    MerlError,
    NotFinite,
    NotSaved,
    check_choice,
    counted,
    suggest,
)
from merl.core.types import (
    CONFIG_FILE,
    METRICS_FILE,
    Agent,
    Batch,
    FrameTransform,
    FrameTransforms,
    Observation,
    Transition,
    is_image,
    is_vector,
)

__all__ = [
    "CONFIG_FILE",
    "METRICS_FILE",
    "Agent",
    "Batch",
    "CallbackFailed",
    "EnvironmentFailed",
    "EnvironmentsLost",
    "EvaluationFailed",
    "FrameTransform",
    "FrameTransforms",
    "MerlError",
    "NotFinite",
    "NotSaved",
    "Observation",
    "Transition",
    "check_choice",
    "counted",
    "is_image",
    "is_vector",
    "suggest",
]
