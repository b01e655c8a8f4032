"""What a long test leaves out of its log, by a rule that stands in the log.

Every byte is logged: that is so wherever a log keeps everything, and a log says with ``/kept`` messages where it does
not. Only the step ``cycle`` asks for that, since a million cycles are alike. Between ``keeping = false`` and
``keeping = true`` samples, bytes, targets and the set-points of cycling are left out; summaries of every cycle, phases,
references, results, events, the operator's acts and all other commands are written as ever. What was left out of the
last `BEFORE_S` seconds is kept in memory, and written late when something happens.
"""

from __future__ import annotations

from collections import deque

from rig.log import schema

KEPT = "/kept"
BEFORE_S = 2.0
MOST_ROWS = 50_000  # of those in memory
LEFT_OUT = frozenset(
    topic for topic in schema.CHANNELS if topic.startswith("/raw/") or topic.endswith("/sample") or topic == "/target"
)
SET_POINTS = ("move_to", "set_voltage")  # commands that cycling gives again and again

Row = tuple[str, bytes, int, int]  # topic, message, the two times


class Decimation:
    """Decides row by row what is written."""

    def __init__(self) -> None:
        self.keeping = True
        self._before: deque[Row] = deque(maxlen=MOST_ROWS)

    def take(self, row: Row) -> list[Row]:
        """The rows that are to be written now that ``row`` comes, in order."""
        topic, data, log_ns, _ = row
        if topic == KEPT:
            fields = schema.decode(topic, data)
            self.keeping = bool(fields["keeping"])
            since = log_ns - round(float(fields["before_s"]) * 1e9)
            late = [one for one in self._before if one[2] > since] if self.keeping else []
            self._before.clear()
            return [row, *late]
        if self.keeping or not self._left_out(topic, data):
            return [row]
        self._before.append(row)
        while log_ns - self._before[0][2] > BEFORE_S * 1e9:
            self._before.popleft()
        return []

    def _left_out(self, topic: str, data: bytes) -> bool:
        return topic in LEFT_OUT or (topic == "/command" and schema.decode(topic, data)["command"] in SET_POINTS)
