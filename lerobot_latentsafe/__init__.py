"""Latent safety filters for LeRobot.

Importing this package loads nothing else: each of its names is imported when it is asked for, and then all types are
registered with LeRobot, too. LeRobot's own commands have them registered by `lerobot_policy_latentsafe`; see
`registration.py`, and `api.py` for what a notebook needs.
"""

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from lerobot_latentsafe.api import (
        EpisodeValues,
        FilterDecision,
        LatentSafePolicy,
        LawOptions,
        decide,
        evaluate_filter,
        load_filter,
        shield_policy,
        train_filter,
        values_along,
    )
    from lerobot_latentsafe.registration import (
        ChunkGuardStep,
        GraspPredictionStep,
        LatentSafeBagEnv,
        LatentSafeBlocksEnv,
        LatentSafeConfig,
        LatentSafeDreamerConfig,
        LatentSafeDubinsEnv,
        LatentSafeEndEffectorConfig,
        LatentSafeFrankaConfig,
        LatentSafeFrankaMujocoConfig,
        LatentSafeScriptedConfig,
        LatentSafeShieldedConfig,
        LatentSafeSO101Env,
        LatentSafeSO101LeaderConfig,
        LatentSafeSO101MujocoConfig,
        NoProprioceptionStep,
    )

__all__ = [
    "ChunkGuardStep",
    "EpisodeValues",
    "FilterDecision",
    "GraspPredictionStep",
    "LatentSafeBagEnv",
    "LatentSafeBlocksEnv",
    "LatentSafeConfig",
    "LatentSafeDreamerConfig",
    "LatentSafeDubinsEnv",
    "LatentSafeEndEffectorConfig",
    "LatentSafeFrankaConfig",
    "LatentSafeFrankaMujocoConfig",
    "LatentSafePolicy",
    "LatentSafeSO101Env",
    "LatentSafeSO101LeaderConfig",
    "LatentSafeSO101MujocoConfig",
    "LatentSafeScriptedConfig",
    "LatentSafeShieldedConfig",
    "LawOptions",
    "NoProprioceptionStep",
    "decide",
    "evaluate_filter",
    "load_filter",
    "shield_policy",
    "train_filter",
    "values_along",
]
__version__ = "0.2.0"


def __getattr__(name: str) -> Any:
    """One of the package's names, imported at first use."""
    if name not in __all__:
        raise AttributeError(f"module 'lerobot_latentsafe' has no attribute {name!r}; it has {', '.join(__all__)}")
    registration = importlib.import_module("lerobot_latentsafe.registration")
    known = registration if name in registration.__all__ else importlib.import_module("lerobot_latentsafe.api")
    return getattr(known, name)


def __dir__() -> list[str]:
    """The package's names, imported or not."""
    return sorted({*globals(), *__all__})
