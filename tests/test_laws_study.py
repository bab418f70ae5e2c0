"""What the study of laws says of episodes, from rows made by hand, and of one episode of the car."""

import json

import pytest

from lerobot_latentsafe.experiments.assurance import laws


def row(outcome, changed=(), adjusted=(), deviation=()):
    known = {"changed": list(changed), "adjusted": list(adjusted), "deviation": list(deviation)} if changed else {}
    return {**{name: name == outcome for name in laws.OUTCOMES}, **known}


def test_a_cell_counts_outcomes_and_what_was_changed():
    rows = [row("success", [True, False], [True, False], [0.5, 0.0]), row("stall", [True, True], [False, True], [2, 1])]
    found = laws.cell(rows)
    assert [found[name]["k"] for name in laws.OUTCOMES] == [0, 1, 1]
    assert (found["steps"], found["changed_share"], found["fallback_share"]) == (4, 0.75, 0.25)
    assert found["deviation"] == pytest.approx(3.5 / 4) and found["deviation_of_changed"] == pytest.approx(3.5 / 3)
    assert "steps" not in laws.cell([row("violation")])


def test_the_laws_are_compared_step_by_step():
    rows = {
        "reachability": [row("success", [True], [False], [2.0])],
        "nearest": [row("success", [True], [True], [0.5])],
    }
    found = laws.against({law: laws.cell(of) for law, of in rows.items()}, rows)
    assert (found["deviation"], found["changed_share"], found["fallback_share"]) == (0.25, 1.0, 0.0)
    idle = {law: [row("success", [False], [False], [0.0])] for law in rows}
    assert laws.against({law: laws.cell(of) for law, of in idle.items()}, idle)["deviation"] is None


def test_every_start_is_run_once_under_each_law():
    jobs = laws.jobs_of("blocks", "dreamer", 23)
    assert set(jobs) == {"bare", *laws.LAWS} and jobs["bare"][0]["filter"] is None
    for of in jobs.values():
        assert [(job["seed"] - laws.STUDIES["blocks"].first_seed, job["n"]) for job in of] == [
            (0, 10),
            (10, 10),
            (20, 3),
        ]
        json.dumps(of)
