from __future__ import annotations

import json

from simbias.mlflow import pages

SWEEP = {
    "name": "table2",
    "hash": "abc",
    "axes": [
        {"name": "noise", "keys": ["hardware.noise.torque_variance", "hardware.noise.angle_variance"]},
        {"name": "hardware.inertia_error", "keys": ["hardware.inertia_error"]},
    ],
}


def test_the_columns_of_a_sweeps_trials_are_its_axes() -> None:
    key, value = pages.trials_view(SWEEP, "0123")
    assert pages.trials_page("7", "abc").endswith("&viewStateShareKey=" + key.removeprefix(pages.VIEW))
    view = json.loads(value)
    state = json.loads(view["state"])
    assert state["selectedColumns"] == [
        "metrics.`experiments/total`",
        "tags.`outcome`",
        "tags.`axis.noise`",
        "params.`hardware.inertia_error`",
    ]
    assert state["columnOrder"] == state["selectedColumns"]  # without it MLflow takes no widths
    assert set(state["columnWidths"]) == set(state["selectedColumns"])
    assert state["searchFilter"] == "tags.`mlflow.parentRunId` = '0123'"
    assert {name: view[name] for name in state} == state
    assert view["name"] == "sweep table2"
    assert len(value) < 5000  # what MLflow keeps of a tag of an experiment


def test_addresses() -> None:
    assert pages.run_page("7", "0123") == "#/experiments/7/runs/0123?workflowType=machine_learning"
    assert "/runs/0123/artifacts/figures/a.png?" in pages.run_page("7", "0123", "figures/a.png")
