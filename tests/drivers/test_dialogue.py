"""The request-and-answer base, against a wire that is two lists."""

from __future__ import annotations

import math
from collections.abc import Callable

import pytest

from drivers.dialogue import LOOK_AGAIN_S, Answer, Ask, Dialogue, Script
from drivers.links.link import DeviceLost, DeviceRefused, DeviceSilent


class Wire:
    """Sends strings; the answer to "x" (n-th transmission) is "x:n"."""

    def __init__(self) -> None:
        self.sent: list[str] = []
        self.gone = False

    def send(self, request: str) -> Callable[[str], bool]:
        if self.gone:
            raise DeviceLost("wire", "gone")
        self.sent.append(request)
        expected = f"{request}:{len(self.sent)}"
        return lambda message: message == expected


@pytest.fixture
def wire() -> Wire:
    return Wire()


@pytest.fixture
def counters() -> dict[str, int]:
    return {}


@pytest.fixture
def dialogue(wire: Wire, counters: dict[str, int]) -> Dialogue[str, str]:
    return Dialogue("wire", wire.send, counters, timeout_s=0.25, retries=2)


def asking(*requests: Ask[str], answers: list[Answer[str]]) -> Script[str, str]:
    for request in requests:
        answers.append((yield request))


def test_one_question_at_a_time_in_order(dialogue: Dialogue[str, str], wire: Wire, counters: dict[str, int]) -> None:
    answers: list[Answer[str]] = []
    dialogue.begin(asking(Ask("a"), Ask("b"), answers=answers))
    dialogue.begin(asking(Ask("c"), answers=answers))
    dialogue.run(1.0)
    assert wire.sent == ["a"]
    assert dialogue.next_poll(1.0) == 1.0 + LOOK_AGAIN_S
    assert dialogue.offer("a:1", 1.004)
    assert wire.sent == ["a", "b"]  # the next question goes out with the answer, not one poll later
    assert dialogue.offer("b:2", 1.006)
    dialogue.run(1.006)
    assert wire.sent == ["a", "b", "c"]
    assert dialogue.offer("c:3", 1.010)
    assert [a.message for a in answers] == ["a:1", "b:2", "c:3"]
    assert [a.t for a in answers] == pytest.approx([1.002, 1.005, 1.008])
    assert dialogue.idle and dialogue.next_poll(1.01) == math.inf
    assert counters["round_trips"] == 3
    assert counters["round_trip_max_us"] == 4000
    assert counters["round_trip_sum_us"] == 10000


def test_answer_that_fits_nothing_is_declined(dialogue: Dialogue[str, str]) -> None:
    assert not dialogue.offer("a:1", 0.0)
    answers: list[Answer[str]] = []
    dialogue.begin(asking(Ask("a"), answers=answers))
    dialogue.run(0.0)
    assert not dialogue.offer("b:1", 0.1)
    assert dialogue.offer("a:1", 0.1)
    assert not dialogue.offer("a:1", 0.1)  # the duplicate
    assert len(answers) == 1


def test_lost_answer_is_asked_again_and_the_late_one_not_taken(
    dialogue: Dialogue[str, str], wire: Wire, counters: dict[str, int]
) -> None:
    answers: list[Answer[str]] = []
    dialogue.begin(asking(Ask("a"), answers=answers))
    dialogue.run(0.0)
    dialogue.run(0.2499)
    assert wire.sent == ["a"]
    dialogue.run(0.25)
    assert wire.sent == ["a", "a"]
    assert not dialogue.offer("a:1", 0.26)
    assert dialogue.offer("a:2", 0.27)
    assert (answers[0].sent, answers[0].received) == (0.25, 0.27)
    assert counters["retries"] == 1 and counters["unanswered"] == 0


def test_silence_raises_after_the_last_retry(
    dialogue: Dialogue[str, str], wire: Wire, counters: dict[str, int]
) -> None:
    dialogue.begin(asking(Ask("a"), answers=[]))
    answers: list[Answer[str]] = []
    dialogue.begin(asking(Ask("b"), answers=answers))
    for t in (0.0, 0.25, 0.5):
        dialogue.run(t)
    with pytest.raises(DeviceSilent, match="wire: no answer to 'a'"):
        dialogue.run(0.75)
    assert wire.sent == ["a"] * 3
    assert counters["unanswered"] == 1
    dialogue.run(0.76)  # what was queued behind it goes on
    assert wire.sent[-1] == "b" and dialogue.offer("b:4", 0.77)


def test_unrepeatable_request_is_sent_once_and_its_script_told(dialogue: Dialogue[str, str], wire: Wire) -> None:
    heard: list[str] = []

    def move() -> Script[str, str]:
        try:
            yield Ask("move", repeat=False)
        except DeviceSilent:
            heard.append((yield Ask("state")).message)

    dialogue.begin(move())
    dialogue.run(0.0)
    dialogue.run(0.3)
    assert wire.sent == ["move", "state"]
    assert dialogue.offer("state:2", 0.31)
    assert heard == ["state:2"] and dialogue.idle


def test_delay_and_own_timeout(dialogue: Dialogue[str, str], wire: Wire, counters: dict[str, int]) -> None:
    dialogue.begin(asking(Ask("a", delay_s=1.0, timeout_s=3.0), answers=[]))
    dialogue.run(0.0)
    assert wire.sent == [] and dialogue.next_poll(0.0) == 1.0
    dialogue.run(1.0)
    assert wire.sent == ["a"]
    dialogue.run(3.9)
    assert wire.sent == ["a"]
    dialogue.run(4.0)
    assert counters["retries"] == 1


def test_error_in_a_script_leaves_and_the_next_script_runs(dialogue: Dialogue[str, str], wire: Wire) -> None:
    def refusing() -> Script[str, str]:
        answer = yield Ask("a")
        raise DeviceRefused("wire", f"said {answer.message}")

    dialogue.begin(refusing())
    answers: list[Answer[str]] = []
    dialogue.begin(asking(Ask("b"), answers=answers))
    dialogue.run(0.0)
    with pytest.raises(DeviceRefused):
        dialogue.offer("a:1", 0.01)
    assert dialogue.next_poll(0.01) == 0.01
    dialogue.run(0.02)
    assert dialogue.offer("b:2", 0.03) and answers[0].message == "b:2"


def test_clear_drops_everything(dialogue: Dialogue[str, str], wire: Wire) -> None:
    dialogue.begin(asking(Ask("a"), answers=[]))
    dialogue.begin(asking(Ask("b"), answers=[]))
    dialogue.run(0.0)
    dialogue.clear()
    assert dialogue.idle
    assert not dialogue.offer("a:1", 0.01)
    dialogue.run(1.0)
    assert wire.sent == ["a"]


def test_vanished_wire_ends_the_script(dialogue: Dialogue[str, str], wire: Wire) -> None:
    wire.gone = True
    dialogue.begin(asking(Ask("a"), answers=[]))
    with pytest.raises(DeviceLost):
        dialogue.run(0.0)
    assert dialogue.idle
