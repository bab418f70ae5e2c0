"""Processors of the task policy: those of the filter, which scale nothing."""

from lerobot_latentsafe.processor_latentsafe import (
    make_latentsafe_pre_post_processors as make_latentsafe_dreamer_pre_post_processors,
)

__all__ = ["make_latentsafe_dreamer_pre_post_processors"]
