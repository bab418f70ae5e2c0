import resource

import pytest
import torch

from lerobot_latentsafe.runtime import malloc


def test_freed_activations_are_reused_not_faulted_in_again():
    if not malloc.keep_freed_memory():
        pytest.skip("this C library has no mallopt")
    faults = lambda: resource.getrusage(resource.RUSAGE_SELF).ru_minflt  # noqa: E731
    each = []
    for _ in range(10):  # 64 MB, which glibc would map anew each time
        before = faults()
        torch.empty(16_000_000).fill_(1)
        each.append(faults() - before)
    assert max(each[-4:]) < 1000, each  # the heap has settled  # a mapping afresh faults in 15,625 pages


def test_a_c_library_without_the_setting_is_left_alone(monkeypatch):
    monkeypatch.setattr(malloc.ctypes, "CDLL", lambda name: object())
    assert malloc.keep_freed_memory.__wrapped__() is False
