"""A log that still grows, streamed into the native Rerun viewer: curves, phases and events, as they are written."""

from __future__ import annotations

import time
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from rig.base.text import printable
from rig.log.follow import Follower, growing
from rig.log.reader import Columns
from rig.view.recording import DISPLACEMENT, EVENTS, FORCE, INK, PHASES, SERIES, TIMELINE, VOLTAGE, time_column

if TYPE_CHECKING:
    import rerun as rr

LOOK_S = 0.05
WINDOW_S = 120.0  # of the curves, up to now
TOPICS = ("/force/sample", "/displacement/sample", "/stage/sample", "/hv/sample", "/phase", "/event")
# Topic, field, factor, and where it goes.
CURVES = (
    ("/force/sample", "force_N", 1.0, FORCE),
    ("/displacement/sample", "displacement_m", 1e3, f"{DISPLACEMENT}/disk"),
    ("/stage/sample", "position_m", 1e3, f"{DISPLACEMENT}/stage"),
    ("/hv/sample", "voltage_V", 1.0, f"{VOLTAGE}/measured"),
    ("/hv/sample", "setpoint_V", 1.0, f"{VOLTAGE}/asked"),
)
LEVELS = {"info": "INFO", "warning": "WARN", "error": "ERROR"}


def stream(log: Path, recording: rr.RecordingStream, goes_on: Callable[[], bool]) -> None:
    """Send what is in ``log`` and what is added, until it has ended or ``goes_on`` says no.

    Raises
    ------
    rig.log.errors.LogError
        The log cannot be read.
    """
    growing(log)
    _prepare(recording, log)
    follower = Follower(log, TOPICS)
    try:
        while goes_on():
            news = follower.read()
            for tables in news.tables:
                _send(recording, tables)
            if news.ended:
                return
            if not news.more:
                time.sleep(LOOK_S)
    finally:
        follower.close()
        recording.flush()


def _prepare(recording: rr.RecordingStream, log: Path) -> None:
    import rerun as rr
    import rerun.blueprint as rrb

    start = rr.TimeRangeBoundary.cursor_relative(seconds=-WINDOW_S)
    axis = rrb.TimeAxis(view_range=rr.TimeRange(start, rr.TimeRangeBoundary.cursor_relative(seconds=0.0)))
    titles = {
        FORCE: "Force / N",
        DISPLACEMENT: "Displacement of the disk, position of the stage / mm",
        VOLTAGE: "Voltage / V (thin: set-point)",
    }
    plots = [rrb.TimeSeriesView(origin=origin, name=title, axis_x=axis) for origin, title in titles.items()]
    events = rrb.TextLogView(origin=EVENTS, name="Events")
    phases = rrb.StateTimelineView(origin=PHASES, name="Protocol", time_view=axis)
    recording.send_recording_name(log.name)
    recording.send_blueprint(
        rrb.Blueprint(
            rrb.Vertical(*plots, phases, events, row_shares=[3, 3, 3, 1.5, 2]),
            rrb.TimePanel(state="collapsed", timeline=TIMELINE, play_state="following"),
            rrb.SelectionPanel(state="hidden"),
            rrb.BlueprintPanel(state="hidden"),
        )
    )
    for _, _, _, path in CURVES:
        thin = path.endswith(("asked", "stage"))
        colour = INK if thin else SERIES[path.split("/")[0]]
        recording.log(path, rr.SeriesLines(colors=colour, names=path, widths=1.0 if thin else 2.0), static=True)


def _send(recording: rr.RecordingStream, tables: dict[str, Columns]) -> None:
    import rerun as rr

    for topic, field, factor, path in CURVES:
        if topic in tables:
            new = tables[topic]
            known = np.isfinite(new[field])
            if known.any():
                columns = rr.Scalars.columns(scalars=new[field][known] * factor)
                recording.send_columns(path, indexes=[time_column(new["t_s"][known])], columns=columns)
    if "/phase" in tables:
        new = tables["/phase"]
        states = [f"{step} {printable(str(kind))}" for step, kind in zip(new["step"], new["kind"], strict=True)]
        columns = rr.StateChange.columns(state=states)
        recording.send_columns(f"{PHASES}/step", indexes=[time_column(new["t_s"])], columns=columns)
    if "/event" in tables:
        new = tables["/event"]
        recording.send_columns(
            EVENTS,
            indexes=[time_column(new["t_s"])],
            columns=rr.TextLog.columns(
                text=[printable(f"{s}: {m}") for s, m in zip(new["source"], new["message"], strict=True)],
                level=[LEVELS.get(str(severity), "INFO") for severity in new["severity"]],
            ),
        )
