"""The filter's card on the Hub: what it saw, what it guards, how epsilon was set, and what it is not."""

from typing import TYPE_CHECKING

from huggingface_hub import ModelCard, ModelCardData

if TYPE_CHECKING:
    from lerobot_latentsafe.baselines.dreamer.configuration_dreamer import LatentSafeDreamerConfig
    from lerobot_latentsafe.configuration_latentsafe import LatentSafeConfig

TEXT = """---
{header}
---

# Latent safety filter

This policy shields another LeRobot policy: it passes the base policy's action while the safety value V of the
predicted next latent stays above epsilon, and otherwise acts itself to preserve safety
([Nakamura, Peters, Bajcsy, 2025](https://kensukenk.github.io/latent-safety/)). Alone it is the fallback policy.

**This is not a certified safety device.** Its value is learned from images: it carries no guarantee, least of all
outside of what its data covered.

| | |
|---|---|
| trained on | `{dataset}` |
| cameras | {cameras} |
| rate | {fps} fps |
| actions (robot units) | {actions} |
| proprioception | {states} |
| world model | {world_model}, {image_size} px |
| failure specification | `{failure}` |
| stage | {stage} |
| epsilon | {epsilon:g} |
| epsilon was set | {calibration} |
| shields | {base} |

```bash
pip install lerobot_policy_latentsafe
lerobot-eval --policy.path={repo_id} --policy.base_policy_path=<your policy> --env.type=...
```

First run it with `--policy.mode=monitor`, which never acts and reports what it would have done.
"""

TASK_POLICY_TEXT = """---
{header}
---

# Task policy learned in imagination

An actor-critic in the imagination of a world model (the DreamerV3 recipe) whose task is to {task}. It is the policy
that a latent safety filter shields in our study: **it fails at times, on purpose**, for its reward prices failures
instead of forbidding them. It was trained on `{dataset}`; its world model is in `world_model/`.

```bash
pip install lerobot_policy_latentsafe
lerobot-eval --policy.path={repo_id} --env.type=...
```
"""


def make_task_policy_card(
    config: "LatentSafeDreamerConfig", dataset_repo_id: str, license: str | None, tags: list[str] | None
) -> ModelCard:
    """The card of a `latentsafe_dreamer` policy."""
    header = _header(dataset_repo_id, license, tags, "latentsafe_dreamer", "world-model")
    repo_id = config.repo_id or "me/policy"
    return ModelCard(TASK_POLICY_TEXT.format(header=header, task=config.task, dataset=dataset_repo_id, repo_id=repo_id))


def _header(dataset_repo_id: str, license: str | None, tags: list[str] | None, name: str, kind: str) -> str:
    return ModelCardData(
        license=license or "apache-2.0",
        library_name="lerobot",
        pipeline_tag="robotics",
        tags=sorted({*(tags or []), "robotics", "lerobot", name, kind}),
        datasets=dataset_repo_id,
        model_name=name,
    ).to_yaml()


def make_model_card(
    config: "LatentSafeConfig", dataset_repo_id: str, license: str | None, tags: list[str] | None
) -> ModelCard:
    """The card of a filter, from its configuration alone."""
    actions = ", ".join(
        f"{name} in [{low:g}, {high:g}]"
        for name, low, high in zip(config.action_names or [], config.action_low or [], config.action_high or [])
    )
    evidence = config.calibration
    calibration = (
        f"on {evidence['failing_episodes']:.0f} held-out failing episodes: {evidence['missed']:.1%} warned later than "
        f"{evidence['lead_steps']:.0f} frames ahead, {evidence['false_alarms']:.1%} false alarms"
        if evidence
        else "by hand"
    )
    return ModelCard(
        TEXT.format(
            header=_header(dataset_repo_id, license, tags, "latentsafe", "safety-filter"),
            dataset=dataset_repo_id,
            cameras=", ".join(f"`{c}` {tuple(config.input_features[c].shape)}" for c in config.cameras or []),
            fps=config.fps,
            actions=actions,
            states=", ".join(config.state_names or []),
            world_model=config.world_model.type,
            image_size=config.world_model.image_size,
            failure=config.failure_specification,
            stage=config.stage,
            epsilon=config.epsilon,
            calibration=calibration,
            base=f"`{config.base_policy_path}`" if config.base_policy_path else "nothing yet",
            repo_id=config.repo_id or "me/filter",
        )
    )
