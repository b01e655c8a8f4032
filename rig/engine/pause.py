"""The operator's pause in the midst of an action."""

from __future__ import annotations

from contextlib import closing

from rig.steps.base import Action, Turns
from rig.steps.output import take_down
from rig.steps.regain import regain
from rig.steps.rig import Rig
from rig.steps.turns import halt

HOW_TO_GO_ON = "To go on: c and Enter here, or `dea-rig continue` elsewhere. To end: s and Enter, or Ctrl-C."


def pause(rig: Rig, action: Action) -> Turns:
    """Stage standing, voltage measured off, until the operator continues; then back to where ``action`` begins.

    He may ask for another pause on the way back.
    """
    while True:
        yield from halt(rig)
        yield from take_down(rig, "the operator's pause")
        state = "the stage stands" + (", the voltage is off" if rig.guard is not None else "")
        rig.control.say(f"Paused: {state}. {HOW_TO_GO_ON}")
        while rig.control.pausing:
            yield
        rig.recorder.operator("continues", "", "")
        rig.event("operator", "continues")
        with closing(regain(rig, action)) as turns:
            for _ in turns:
                yield
                if rig.control.pausing:
                    rig.recorder.operator("pauses", "on the way back from a pause", rig.control.pausing)
                    rig.event("operator", f"paused again by {rig.control.pausing}")
                    break
            else:
                return
