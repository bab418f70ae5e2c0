"""The benchmark of whole ticks: what it says of the slowest of them."""

from lerobot_latentsafe.experiments.bag.tick_time import Tick, in_ms


def test_the_slowest_hundredth_is_told_apart_by_what_happened_in_it():
    said = in_ms([Tick(0.01, 0, 1, 0)] * 99 + [Tick(0.09, 200, 9, 1)], period=1 / 15)
    assert said["late"] == 0.01 and said["p50_ms"] == 10.0
    assert said["in_the_slowest"] == {"faults": 200.0, "preempted": 9.0, "collected": 1.0}
    assert said["in_all"]["faults"] == 2.0


def test_what_a_tick_took_is_what_came_since_it_began():
    assert Tick(2.0, 10, 5, 3).since(Tick(1.5, 4, 5, 1)) == Tick(0.5, 6, 0, 2)
    assert Tick.now().since(Tick.now()).wall_s <= 0
