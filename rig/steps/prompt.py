"""``do = "prompt"``: the operator is asked to do something."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import ClassVar, Literal

from pydantic import Field

from rig.base.errors import LimitError
from rig.operator.control import Question
from rig.scene.scene import Scene
from rig.steps.base import Action, State, Step, Turns
from rig.steps.output import take_down
from rig.steps.rig import Rig


class Prompt(Step):
    """Ask the operator to do something (mount the specimen, close the lid) and wait for his answer; voltage off."""

    hands: ClassVar[bool] = True

    do: Literal["prompt"] = Field(description="The kind of step.")
    text: str = Field(
        min_length=1,
        max_length=200,
        pattern=r"^[^\x00-\x1f\x7f]*$",
        description="What the operator is asked; his answer goes into the log. One line.",
    )

    def plan(self, state: State, scene: Scene) -> Iterator[Action]:
        if state.voltage > 0:
            raise LimitError(
                f"{self.where(state.number)} comes with {state.voltage:g} V on; put the voltage to 0 first."
            )
        yield Asking(by=self, step=state.number, label=self.text, h=(state.h, state.h))


@dataclass(frozen=True, kw_only=True)
class Asking(Action):
    """Whoever is asked may touch the rig, so the voltage is off and latched before."""

    @property
    def asks(self) -> bool:
        return True

    def carry_out(self, rig: Rig) -> Turns:
        yield from take_down(rig, "the operator is asked")
        yield from rig.ask(Question(self.label))


def ask_first(step: int, text: str) -> Asking:
    """The question with which a resumed run begins, before its first ``step``."""
    return Asking(by=Prompt.model_construct(do="prompt", text=text), step=step, label=text)
