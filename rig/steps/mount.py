"""``do = "mount"``: the operator puts something before the pusher."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import ClassVar, Literal

from pydantic import Field

from rig.operator.control import Question
from rig.scene.scene import Scene
from rig.steps.base import Action, State, Step, Turns
from rig.steps.output import take_down
from rig.steps.rig import Rig
from rig.steps.standards import OPERATOR_S, check_place

Fixture = Literal["film", "target", "dummy", "none"]

WORDS: dict[Fixture, str] = {
    "film": "Mount the specimen.",
    "target": "Fix the target plate to the pusher, in the laser's range, so that nothing touches it.",
    "dummy": "Mount the rigid dummy and turn its screw until it just touches the pusher where it stands.",
    "none": "Clear the way before the pusher: nothing may touch it or the force sensor.",
}


class Mount(Step):
    """Ask the operator to mount something before the pusher.

    ``film``: the specimen. ``target``: a plate on the pusher, for the laser. ``dummy``: a rigid stop that just touches
    the pusher where it stands. ``none``: nothing that can be touched.
    """

    hands: ClassVar[bool] = True

    do: Literal["mount"] = Field(description="The kind of step.")
    fixture: Fixture = Field(
        description="film: the specimen; target: a plate on the pusher, for the laser; dummy: a rigid stop that just "
        "touches the pusher; none: nothing that can be touched."
    )

    def plan(self, state: State, scene: Scene) -> Iterator[Action]:
        check_place(self, state)
        yield Mounting(
            by=self,
            step=state.number,
            label=f"mount: {self.fixture}",
            duration=OPERATOR_S,
            fixture=self.fixture,
        )


@dataclass(frozen=True, kw_only=True)
class Mounting(Action):
    """The voltage is off and latched before hands come near."""

    fixture: Fixture

    @property
    def asks(self) -> bool:
        return True

    def carry_out(self, rig: Rig) -> Turns:
        yield from take_down(rig, "the operator's hands come near")
        yield from rig.ask(Question(WORDS[self.fixture]), lambda hands: hands.mount(self.fixture, rig.clock.now()))
