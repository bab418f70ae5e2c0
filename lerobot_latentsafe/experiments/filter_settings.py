"""Filters as experiments run them, and what of them goes into a job and a table of results."""

import hashlib
from dataclasses import asdict, dataclass
from functools import cache

from lerobot_latentsafe.base_policy import BasePolicy
from lerobot_latentsafe.decision import LawConfig, LawOptions
from lerobot_latentsafe.modeling_latentsafe import LatentSafePolicy, load_filter
from lerobot_latentsafe.runtime.checkpoint import WEIGHTS, read_config
from lerobot_latentsafe.runtime.locations import CONFIG, resolve_checkpoint

OPTIONS = ("epsilon", "proposal_steps", "resume_above", "kappa", "replan_above")
"""Of a law, what studies change."""


@dataclass(frozen=True)
class FilterSetting:
    """A filter under a law: all that its decisions depend on."""

    path: str
    law: str
    epsilon: float
    proposal_steps: int
    resume_above: float
    kappa: float
    replan_above: float
    fingerprint: str

    @classmethod
    def of(cls, path: str, options: LawOptions) -> "FilterSetting":
        """The filter's own law, with what is given of these options."""
        law = law_of(path).changed(options)
        return cls(
            path=path, law=law.name, fingerprint=fingerprint(path), **{name: getattr(law, name) for name in OPTIONS}
        )

    @classmethod
    def from_job(cls, job: dict | None) -> "FilterSetting | None":
        """The inverse of `as_job`."""
        return cls(**job) if job else None

    def load(self, base: str | BasePolicy | None = None) -> LatentSafePolicy:
        """The filter, with the policy it is to shield, if any."""
        options = {name: getattr(self, name) for name in OPTIONS}
        return load_filter(self.path, law=LawOptions(name=self.law, **options), base_policy=base)


def as_job(setting: FilterSetting | None) -> dict | None:
    """As a JSON-able part of a job."""
    return asdict(setting) if setting else None


def law_of(path: str) -> LawConfig:
    """A checkpoint's own law."""
    return read_config(resolve_checkpoint(path)).law


def in_use(settings: list[FilterSetting]) -> dict[str, dict]:
    """Path -> what a table notes of a filter beside its rates, under the names that results have had from the first."""
    rows: dict[str, dict] = {}
    for setting in settings:
        row, own = rows.setdefault(setting.path, {}), law_of(setting.path)
        row |= {"epsilon": setting.epsilon, "guard": setting.proposal_steps, "release": setting.resume_above}
        row |= {name: getattr(setting, name) for name in ("kappa", "replan_above") if setting.law == "nearest"}
        row |= {"memory": own.history_frames} if own.history_frames else {}
        if own.retreat:
            row |= {"retreat": own.retreat, "patience": own.retreat_after, "dwell": own.min_retreat_steps}
            row |= {"most": own.max_retreat_steps} if own.max_retreat_steps else {}
    return rows


@cache
def fingerprint(path: str) -> str:
    """Hash of a checkpoint's weights and configuration."""
    files = [resolve_checkpoint(path) / name for name in (CONFIG, WEIGHTS)]
    return hashlib.sha256(b"".join(file.read_bytes() for file in files)).hexdigest()[:16]
