"""Types, errors and small helpers that every package of merl may import."""

from merl.core.errors import (
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
    Kind,
    Observation,
    Transition,
)

__all__ = [
    "CONFIG_FILE",
    "METRICS_FILE",
    "Agent",
    "Batch",
    "EnvironmentFailed",
    "EnvironmentsLost",
    "EvaluationFailed",
    "FrameTransform",
    "FrameTransforms",
    "Kind",
    "MerlError",
    "NotFinite",
    "NotSaved",
    "Observation",
    "Transition",
    "check_choice",
    "counted",
    "suggest",
]
