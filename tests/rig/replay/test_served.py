"""How requests that do not come as then are answered from a log in real time."""

from __future__ import annotations

import pytest

from drivers.instruments.zaber.codec import Codec, Reply, encode
from drivers.recorded import Passed
from drivers.registry import registered
from rig.replay.served import Lag, ServedScript


class Departed(Exception):
    pass


DIALECTS = {one.driver: one.dialect for one in registered().instruments.values()}


def script(rows, driver="zaber", lag=None):
    def depart(t, made):
        raise Departed(made)

    return ServedScript([Passed(*row) for row in rows], depart, DIALECTS[driver], lag or Lag())


def zaber(positions, command):
    """A stage that is asked for its position every 0.1 s, with a command after the last of them, then asked again."""
    rows, t = [], 0.0
    words = ["get pos"] * len(positions) + [command] + ["get pos"]
    for n, (word, data) in enumerate(zip(words, [*positions, "0", "7777"], strict=True)):
        reply = f"01 1 {n:02d} OK BUSY -- {data}"
        rows.append((t, True, encode(1, 1, n, word)))
        check = -sum(reply.encode()) & 0xFF
        whole = f"@{reply}:{check:02X}\r\n".encode()
        rows += [(t + 0.01, False, whole[:5]), (t + 0.02, False, whole[5:])]
        t += 0.1
    return rows


def ask(one, t, number, words):
    one.write(encode(1, 1, number, words), t)
    (reply,) = Codec().feed(b"".join(one.read(t + 0.05)))
    assert isinstance(reply, Reply) and reply.id == number  # and its checksum is right
    return int(reply.data)


POSITIONS = [str(100 * n) for n in range(30)]


def test_a_question_is_answered_by_that_of_the_same_time():
    one = script(zaber(POSITIONS, "move abs 5"))
    assert [ask(one, t, n, "get pos") for n, t in enumerate((0.0, 0.11, 0.12, 0.52, 0.49))] == [0, 100, 100, 500, 500]


def test_after_a_command_time_goes_on_from_there():
    lag = Lag()
    one = script(zaber(POSITIONS, "move abs 5"), lag=lag)
    assert ask(one, 0.0, 60, "get pos") == 0
    assert ask(one, 4.0, 61, "get pos") == 2900  # nothing beyond the command, however late it is
    ask(one, 5.0, 62, "move abs 5")
    assert lag.s == pytest.approx(2.0)
    assert ask(one, 5.1, 63, "get pos") == 7777


def test_another_command_is_refused():
    one = script(zaber(POSITIONS, "move abs 5"))
    with pytest.raises(Departed, match="move abs 26"):
        one.write(encode(1, 1, 3, "move abs 26"), 3.0)
    with pytest.raises(Departed, match="move vel 5"):
        one.write(encode(1, 1, 4, "move vel 5"), 3.0)
    assert b"move abs 5" in one.due.data


def test_a_motion_to_nearly_the_same_place_is_the_same():
    """Where contact is follows from a mean over readings, and which readings those are is left to chance."""
    one = script(zaber(POSITIONS, "move abs 12092"))
    ask(one, 3.0, 3, "move abs 12095")
    assert ask(one, 3.1, 4, "get pos") == 7777


@pytest.mark.parametrize(("later", "missed"), [(0.004, True), (0.1, False)])
def test_a_motion_may_be_missing_that_was_stopped_at_once(later, missed):
    rows = zaber(POSITIONS, "move abs 5")[:-3]
    t = rows[-1][0] + later
    one = script([*rows, (t, True, encode(1, 1, 90, "stop")), (t + 0.01, False, b"@01 1 90 OK BUSY -- 0\r\n")])
    if missed:
        assert ask(one, 3.0, 7, "stop") == 0
    else:
        with pytest.raises(Departed, match="stop"):
            one.write(encode(1, 1, 7, "stop"), 3.0)


@pytest.mark.parametrize(("early", "taken"), [(0.03, True), (0.3, False)])
def test_a_motion_may_be_made_that_would_have_been_stopped_at_once(early, taken):
    """Then the reading that stopped it came just before it was made; now, just after."""
    rows = zaber(POSITIONS, "move abs 5")[:-3]
    t = rows[-1][0] + 1.0
    rows += [(t, True, encode(1, 1, 90, "stop")), (t + 0.01, False, b"@01 1 90 OK BUSY -- 1\r\n")]
    one = script(rows)
    assert ask(one, 3.0, 7, "move abs 5") == 0
    if not taken:
        with pytest.raises(Departed, match="move abs 500"):
            one.write(encode(1, 1, 8, "move abs 500"), t - early)
        return
    assert ask(one, t - early, 8, "move abs 500") == 0  # as the motion before it was answered
    assert ask(one, t, 9, "stop") == 1


def test_a_command_may_come_before_its_time_but_not_twice():
    one = script(zaber(POSITIONS, "move abs 5"))
    ask(one, 0.5, 3, "move abs 5")
    with pytest.raises(Departed):
        one.write(encode(1, 1, 4, "move abs 5"), 0.6)


def test_a_stream_goes_with_the_lag_of_all():
    start = bytes.fromhex("AA902485")
    rows = [(1.0, True, start), (1.01, False, b"ok"), *((1.0 + n, False, b"%d" % n) for n in range(1, 5))]
    lag = Lag()
    one = script(rows, "gsv8", lag)
    one.write(start[:2], 2.0)
    one.write(start[2:], 2.0)
    assert one.read(2.02) == [b"ok"]
    assert one.next_arrival == pytest.approx(3.0)
    assert one.read(3.5) == [b"1"]
    lag.s = 2.0  # another instrument was commanded a second later than then
    assert one.read(4.5) == [b"2"][:0]
    assert one.read(5.0) == [b"2"]
