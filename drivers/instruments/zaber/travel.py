"""How far a Zaber stage goes per motor step: no setting on the wire says it, only who the stage is.

A stage with a controller of its own is known by its device id. One that is plugged into a controller (X-MCC and the
like) is a peripheral: it has an id, and with firmware 7 a serial number of its own, which the controller states. Where
the id is not known here, the scene has to say it: a wrong letter in a model's name is a factor of 4 or 5.
"""

from __future__ import annotations

from typing import NamedTuple

FULL_STEP_UM = {50_081: 31.75}
"""By device id of stages with a controller of their own: X-LSQ150B (6.35 mm screw, 200 steps a turn)."""

FAMILIES = "LSQ..A 6.35, LSQ..B and LSM..B and LSR..B 31.75, LSQ..D 127, LRM..A and LSM..A 3.048, LRM..B 12.192, ASR 10"
"""Travel per full step (um) of families, from working code and data sheets: to be held against the stage's own."""


class Peripheral(NamedTuple):
    """What is plugged into a controller's axis: 0 where it is nothing, or does not say."""

    id: int
    serial: int


def full_step_um(given: float | None, device_id: int, peripheral: Peripheral) -> float | None:
    """Travel per full step (um): as the scene says, or as it is known; None where it is not."""
    if given is not None:
        return given
    return None if peripheral.id else FULL_STEP_UM.get(device_id)


def not_known(device_id: int, peripheral: Peripheral, travel_full_steps: float) -> tuple[str, str]:
    """What is said of a stage whose travel per step is not known, and what to do."""
    who = f"device {device_id}" + (f" with peripheral {peripheral.id}" if peripheral.id else "")
    return (
        f"it is not known how far {who} goes per motor step, and it does not say so itself",
        f"Give stage.full_step_um: screw pitch over steps a turn. Of families (um): {FAMILIES}. Its travel of "
        f"{travel_full_steps:.0f} full steps would be {travel_full_steps * 31.75e-3:.1f} mm at 31.75: compare that "
        "with the travel in its name.",
    )


def swapped(axis: int, one: Peripheral, wanted: int | None) -> tuple[str, str]:
    """What is said of another peripheral than the scene wants, and what to do."""
    return (
        f"axis {axis} has peripheral {one.id or 'none'}, and peripheral_id = {wanted} is wanted",
        "Are two stages plugged in swapped? Check the cables at the controller.",
    )
