"""From protocol steps to actions: what the engine will do, how long it takes, in what order.

Every action goes from one displacement and voltage to another; that is what the limits are checked on before
anything moves (`rig.protocol.predict`), and what the engine then carries out.
"""

from __future__ import annotations

from collections.abc import Collection, Iterable, Iterator, Mapping

from rig.base.errors import ConfigError, LimitError
from rig.protocol.protocol import Protocol
from rig.scene.scene import Scene
from rig.steps.base import Action, OnResume, State, Step
from rig.steps.prompt import ask_first
from rig.steps.regain import Regain
from rig.steps.rig import CyclesDone

MOST_ACTIONS = 50_000  # a protocol of more is a slip: so many moves take days
LONGEST_S = 90 * 86_400.0

CYCLES, REFERENCE = "cycles_done", "cycle_response_reference"  # in the metadata ``resumed`` of a log


def plan(protocol: Protocol, scene: Scene) -> list[Action]:
    """All actions of ``protocol`` on ``scene``, in order.

    Raises
    ------
    LimitError
        When the protocol needs what the scene does not have (a voltage without ``[hv]``), or asks for steps in an
        order that cannot work. Numerical limits are checked by `rig.protocol.predict.check_plan`.
    ConfigError
        When it would take more actions, or more time, than can be meant.
    """
    return list(_actions(enumerate(protocol.step, start=1), scene))


def plan_resumed(
    protocol: Protocol,
    scene: Scene,
    first: int,
    still_valid: Collection[int],
    question: str,
    done: CyclesDone | None = None,
) -> list[Action]:
    """What a resumed run does: the question whether all is as it was, and the rest of the protocol (`plan_from`)."""
    return [ask_first(first, question), *plan_from(protocol, scene, first, still_valid, done)]


def earlier_cycles(resumed: Mapping[str, str]) -> CyclesDone | None:
    """What the metadata ``resumed`` of a log says that the run before it had counted; ValueError for what is none."""
    if CYCLES not in resumed:
        return None
    return CyclesDone(int(resumed[CYCLES]), float(resumed.get(REFERENCE, "nan")))


def plan_from(
    protocol: Protocol, scene: Scene, first: int, skipped: Collection[int] = (), done: CyclesDone | None = None
) -> list[Action]:
    """The actions from step ``first`` on, with what has to be done again before it.

    ``done`` is what had been counted of step ``first``.

    Of the steps before, those are done again that say so (`OnResume`), but for the steps ``skipped``; then the
    displacement and the voltage are regained with which the step begins.

    Raises
    ------
    ConfigError
        There is no such step.
    LimitError
        As `plan`.
    """
    numbered = list(enumerate(protocol.step, start=1))
    whole = plan(protocol, scene)
    if not 1 <= first <= len(numbered):
        raise ConfigError(f"The protocol has no step {first} to go on with.")
    while first <= len(numbered) and numbered[first - 1][1].on_resume is OnResume.ENDS_CONTACT:
        first += 1  # the way back has been done again with the reference position
    begin = next((action for action in whole if action.step >= first), None)
    if begin is None:
        raise ConfigError("Nothing but the way back is left to be done of this protocol.")
    before: list[tuple[int, Step]] = sorted(_again(numbered[: first - 1], skipped).items())
    if begin.h[0] > 0 or begin.voltage[0] > 0:
        before.append((first, Regain(h=begin.h[0], voltage=begin.voltage[0])))
    return list(_actions([*before, *numbered[first - 1 :]], scene, {} if done is None else {first: done}))


def _again(done: list[tuple[int, Step]], skipped: Collection[int]) -> dict[int, Step]:
    """Which of the steps ``done`` are done again, by number."""
    since = max((number for number, step in done if step.on_resume is OnResume.ENDS_CONTACT), default=0)
    last = {step.kind: number for number, step in done if step.on_resume is OnResume.LAST_ONE}
    again = {number: step for number, step in done if number in last.values()}
    if any(step.finds_contact for number, step in done if number > since):
        again |= {
            number: step
            for number, step in done
            if number > since and step.on_resume is OnResume.IN_CONTACT and number not in skipped
        }
    return again


def _actions(
    numbered: Iterable[tuple[int, Step]], scene: Scene, done: Mapping[int, CyclesDone] | None = None
) -> Iterator[Action]:
    state = State()
    count, seconds = 0, 0.0
    for number, step in numbered:
        state.number, state.done = number, (done or {}).get(number)
        where, highest = step.where(number), step.highest_voltage
        if highest > 0 and scene.hv is None:
            raise LimitError(f"{where} asks for {highest:g} V, but the scene has no [hv] instrument.")
        if step.needs_contact and not state.contact:
            raise LimitError(f"{where} needs the contact position: put an approach step before it.")
        for action in step.plan(state, scene):
            count, seconds = count + 1, seconds + action.duration
            if count > MOST_ACTIONS:
                raise ConfigError(
                    f"{where}: up to here the protocol has more than {MOST_ACTIONS} actions (moves, ramps, holds); "
                    "that can hardly be meant. Ask for fewer cycles or voltages, or split it into several runs."
                )
            if not seconds <= LONGEST_S:
                raise ConfigError(
                    f"{where}: up to here the protocol takes {seconds / 86_400:.3g} days; at most "
                    f"{LONGEST_S / 86_400:.0f} are allowed. Is a speed too small, or a duration too long?"
                )
            yield action
