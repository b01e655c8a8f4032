"""What a driver assumes where nothing is said is what the key of its scene says; the exceptions are written down."""

from __future__ import annotations

import inspect
from typing import Any

import pytest
from pydantic_core import PydanticUndefined

from drivers.registry import registered

# What only a scene knows (how long an instrument starts), and what a driver alone is quicker at than in a scene.
OTHERWISE: dict[tuple[str, str], Any] = {
    ("shvps", "looks_at_jack"): True,  # but for recorded dialogues
    ("keyence-lkg", "poll_rate_Hz"): 100.0,
    ("keyence-lkg", "timeout_s"): 0.1,
    ("shvps", "poll_rate_Hz"): 20.0,
    ("shvps", "timeout_s"): 0.1,
}
# Of the driver's own, without a key: the unit as a word is made of the key's.
WITHOUT_KEY: dict[str, Any] = {
    "poll_interval_s": 0.01,
    "settle_s": 0.2,
    "looks_first": False,
    "unit": "",
    "quantity": "voltage",
}
TO_SI = {"ascii-stream": (1.0, 0.0), "scpi": (1.0, 0.0), "labjack-monitor": (1000.0, 0.0)}


@pytest.mark.parametrize("one", registered().instruments.values(), ids=lambda one: f"{one.driver} as {one.role}")
def test_a_driver_assumes_what_the_key_of_its_scene_says(one: Any) -> None:
    parameters = inspect.signature(one.device).parameters
    keys = {name: field.default for name, field in one.settings.model_fields.items()}
    for name, parameter in parameters.items():
        if parameter.default is inspect.Parameter.empty:
            continue
        if name == "to_si":
            expected = TO_SI[one.driver]
        elif name == "boot_s" and one.driver != "ascii-stream":
            expected = 0.0
        elif (one.driver, name) in OTHERWISE:
            expected = OTHERWISE[one.driver, name]
        elif name in WITHOUT_KEY and (name not in keys or keys[name] in (PydanticUndefined, "N", "mm", None)):
            expected = WITHOUT_KEY[name] if name != "unit" or one.driver != "cia404" else None
        else:
            expected = keys[name]
        assert parameter.default == expected, name
