"""One run as the panel knows it: what its log says, what the run says of itself, what the plan and model expect."""

from __future__ import annotations

import json
import math
import subprocess
import sys
import threading
import time
from collections import deque
from collections.abc import Callable
from contextlib import suppress
from enum import Enum
from pathlib import Path
from typing import Any, ClassVar

import numpy as np

from drivers.instrument import MONITORS
from drivers.roles import HVFlag
from rig.base.errors import RigError
from rig.log.contents import AIR
from rig.log.errors import LogError
from rig.log.follow import Follower, News
from rig.log.reader import Columns
from rig.operator.control import CONTINUE, PAUSE, STOP
from rig.operator.live import LiveRun, live_run
from rig.panel.queue import queue_of
from rig.panel.series import Binned, Loop

SAFE_VOLTAGE = 60.0  # V: below it an output counts as off, as in `rig.safety`
LOOK_S = 0.08  # between two looks at the log
QUEUE_S = 5.0  # between two looks at what is done of the campaign
ASK_S = 0.25  # between two questions to the run
OLD_S = 1.0  # data older than this are said to be old
MOST_EVENTS = 100
LOOP_S = 0.1  # between two points of the force-displacement loop
OUTLOOK_LIMIT_S = 120.0
TOPICS = (
    *("/reference", "/phase", "/stage/sample", "/force/sample", "/displacement/sample", "/hv/sample"),
    *("/event", "/target", "/cycle"),
    *(f"/{name}/sample" for name in MONITORS),
)
# What a run says of itself, as the page has it: name, what it is of, factor.
SAID = (
    ("force_mN", "force_N", 1e3),
    ("displacement_mm", "displacement_m", 1e3),
    ("voltage_V", "voltage_V", 1.0),
    ("current_uA", "current_A", 1e6),
)


class State(Enum):
    """What the page shows in its large colour. A state that is not known is shown as dangerous."""

    SAFE = "SAFE"  # measured off, and the data are fresh or the run has ended so
    ARMED = "ARMED"  # the channel is on or has a set-point, the output is below the safe voltage
    LIVE = "LIVE"  # the output is not below the safe voltage
    NOT_SAFE = "NOT SAFE"  # the run ended and could not prove that the output is off
    UNKNOWN = "UNKNOWN"  # no voltage was measured yet, or the data are old
    NO_HV = "NO HIGH VOLTAGE"  # the scene has no supply


class RunView:
    """Follows one log on a thread of its own; `page` is what the page asks for.

    Raises `LogError` when the log cannot be read.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self._follower = Follower(path, TOPICS)
        self._lock = threading.Lock()
        self._traces = {name: Binned() for name in ("force_mN", "displacement_mm", "voltage_V", "current_uA")}
        self._loop = Loop()
        self._latest: dict[str, float | None] = {}
        self._flags = HVFlag(0)
        self._has_hv = False
        self._has_laser = False
        self._contact = math.nan
        self._phases: list[dict[str, Any]] = []
        self._events: deque[dict[str, Any]] = deque(maxlen=MOST_EVENTS)
        self._texts: dict[str, str] = {}
        self._metadata: dict[str, dict[str, str]] = {}
        self._outlook: dict[str, Any] | None = None
        self._arrived = time.monotonic()
        self._t = 0.0
        self._next_point = -math.inf
        self._placed: tuple[float, float] | None = None  # time and reading of the newest displacement
        self._run: LiveRun | None = None
        self._said: dict[str, str] = {}
        self._queue: dict[str, Any] = {}
        self._next_queue = -math.inf
        self._error = ""
        self._closing = threading.Event()
        self._take(self._follower.read())
        self._reading = threading.Thread(target=self._watch, name="panel: log", daemon=True)
        self._reading.start()
        threading.Thread(target=self._ask, name="panel: run", daemon=True).start()

    # Threads -------------------------------------------------------------------------------------------------

    def _watch(self) -> None:
        """Read what is new until the log has ended."""
        while not self._closing.wait(LOOK_S):
            try:
                news = self._follower.read()
                while news.more and not self._closing.is_set():
                    self._take(news)
                    news = self._follower.read()
                self._take(news)
            except LogError as error:
                self._error = str(error)
                return
            if news.ended:
                return

    def _ask(self) -> None:
        """Ask the run how it is, as long as it lives; compute the outlook once its scene is known."""
        while not self._closing.wait(ASK_S):
            if self._outlook is None and {"scene", "protocol"} <= self._texts.keys():
                self._outlook = {}
                threading.Thread(target=self._look_ahead, name="panel: outlook", daemon=True).start()
            self._look_at_queue()
            if self._follower.ended:
                self._run, self._said = None, {}
                if self._outlook is not None:
                    return
                continue
            try:
                if self._run is None:
                    self._run = live_run(self.path)
                self._said = self._run.send("status")
                self._take_said(self._said)
            except (RigError, OSError):
                self._run, self._said = None, {}

    def _look_at_queue(self) -> None:
        told = self._metadata.get("campaign")
        if told is not None and time.monotonic() >= self._next_queue:
            self._next_queue = time.monotonic() + QUEUE_S
            self._queue = queue_of(self.path, told)

    def _take_said(self, said: dict[str, str]) -> None:
        """What the run says that it measures now: where its log leaves most out (`rig.log.decimation`)."""
        if "t_s" not in said:
            return
        with self._lock:
            t = float(said["t_s"])
            if not t > self._t:
                return
            self._arrived = time.monotonic()
            for name, of, scale in SAID:
                if of in said:
                    self._add(name, np.array([t]), np.array([float(said[of]) * scale]))
            self._t = t

    def _look_ahead(self) -> None:
        try:
            done = subprocess.run(
                [sys.executable, "-P", "-m", "rig.panel.outlook"],
                input=json.dumps(self._texts),
                capture_output=True,
                text=True,
                timeout=OUTLOOK_LIMIT_S,
            )
            self._outlook = json.loads(done.stdout)
        except (OSError, ValueError, subprocess.SubprocessError):
            self._outlook = {"error": "The model's curves could not be computed."}

    # What the log says ---------------------------------------------------------------------------------------

    def _take(self, news: News) -> None:
        with self._lock:
            for name, data in news.attachments.items():
                if name in ("scene.toml", "protocol.toml"):
                    self._texts[name.removesuffix(".toml")] = data.decode(errors="replace")
            self._metadata |= news.metadata
            for tables in news.tables:
                self._arrived = time.monotonic()
                for topic in TOPICS:  # references and phases before what is measured with them
                    if topic in tables:
                        self._taking[topic](self, tables[topic])
                if "/force/sample" in tables:
                    self._take_loop(tables)

    def _take_force(self, new: Columns) -> None:
        self._add("force_mN", new["t_s"], new["force_N"] * 1e3)

    def _take_loop(self, tables: dict[str, Columns]) -> None:
        """Force over displacement, a point every `LOOP_S`, where the film is in contact."""
        force = tables["/force/sample"]
        if self._has_laser and "/displacement/sample" in tables:
            of, zero = tables["/displacement/sample"], 0.0
            values = of["displacement_m"]
        elif not self._has_laser and "/stage/sample" in tables and math.isfinite(self._contact):
            of, zero = tables["/stage/sample"], self._contact
            values = of["position_m"]
        else:
            return
        before = [self._placed] if self._placed is not None else []
        times = np.concatenate([[t for t, _ in before], of["t_s"]])
        places = (np.concatenate([[place for _, place in before], values]) - zero) * 1e3
        self._placed = (float(of["t_s"][-1]), float(values[-1]))
        starts = np.array([phase["t_s"] for phase in self._phases])
        for t, newtons in zip(force["t_s"].tolist(), force["force_N"].tolist(), strict=True):
            if not max(self._next_point, times[0]) <= t <= times[-1]:
                continue  # between two displacements only
            now = int(np.searchsorted(starts, t, side="right")) - 1
            if now < 0 or not self._phases[now]["contact"]:
                continue
            self._next_point = t + LOOP_S
            self._loop.add(float(np.interp(t, times, places)), newtons * 1e3, self._phases[now]["voltage_V"])

    def _take_displacement(self, new: Columns) -> None:
        self._has_laser = True
        self._add("displacement_mm", new["t_s"], new["displacement_m"] * 1e3)

    def _take_stage(self, new: Columns) -> None:
        self._latest["stage_mm"] = _finite(float(new["position_m"][-1]) * 1e3)
        self._latest["moving"] = float(new["moving"][-1])
        if not self._has_laser and math.isfinite(self._contact):
            self._add("displacement_mm", new["t_s"], (new["position_m"] - self._contact) * 1e3)

    def _take_reference(self, new: Columns) -> None:
        for name, value in zip(new["name"], new["value"].tolist(), strict=True):
            if name == "contact_position":
                self._contact = value

    def _take_hv(self, new: Columns) -> None:
        self._has_hv = True
        self._add("voltage_V", new["t_s"], new["voltage_V"])
        self._add("current_uA", new["t_s"], new["current_A"] * 1e6)
        self._latest["setpoint_V"] = _finite(float(new["setpoint_V"][-1]))
        self._flags = HVFlag(int(new["flags"][-1]))

    def _take_monitor(self, new: Columns) -> None:
        for field, name, scale, zero in (("voltage_V", "second_V", 1.0, 0.0), *AIR):
            if np.isfinite(new[field]).any():
                self._latest[name] = _finite(float(new[field][-1]) * scale + zero)

    def _take_phase(self, new: Columns) -> None:
        for k in range(len(new["t_s"])):
            kind = str(new["kind"][k])
            contact = kind not in ("home", "zero", "approach", "mount") and any(
                phase["kind"] == "approach" for phase in self._phases
            )
            self._phases.append(
                {
                    "t_s": float(new["t_s"][k]),
                    "step": int(new["step"][k]),
                    "kind": kind,
                    "label": str(new["label"][k]),
                    "voltage_V": float(new["voltage_V"][k]),
                    "contact": contact,
                }
            )

    def _take_event(self, new: Columns) -> None:
        for k in range(len(new["t_s"])):
            self._events.append(
                {
                    "t_s": round(float(new["t_s"][k]), 2),
                    "severity": str(new["severity"][k]),
                    "source": str(new["source"][k]),
                    "message": str(new["message"][k]),
                }
            )

    def _take_target(self, new: Columns) -> None:
        self._latest["target_mm"] = _finite(float(new["displacement_m"][-1]) * 1e3)

    def _take_cycle(self, new: Columns) -> None:
        self._latest["cycle"] = float(new["cycle"][-1])

    _taking: ClassVar[dict[str, Callable[[RunView, Columns], None]]] = {
        "/reference": _take_reference,
        "/force/sample": _take_force,
        "/displacement/sample": _take_displacement,
        "/stage/sample": _take_stage,
        "/hv/sample": _take_hv,
        "/phase": _take_phase,
        "/event": _take_event,
        "/target": _take_target,
        "/cycle": _take_cycle,
        **dict.fromkeys((f"/{name}/sample" for name in MONITORS), _take_monitor),
    }

    def _add(self, name: str, t: np.ndarray[Any, Any], value: np.ndarray[Any, Any]) -> None:
        self._traces[name].add(t, value)
        self._latest[name] = _finite(float(value[-1]))
        self._t = max(self._t, float(t[-1]))

    # What the page asks for ----------------------------------------------------------------------------------

    @property
    def age(self) -> float:
        """Seconds since something new was read; 0 once the log has said how the run ended."""
        return 0.0 if "outcome" in self._metadata else time.monotonic() - self._arrived

    @property
    def simulated(self) -> bool:
        """Whether the log says that the bench was a simulated one."""
        return self._metadata.get("run", {}).get("bench", "").startswith("sim")

    @property
    def state(self) -> State:
        """Safe, armed, live, ... by what was measured; what is not known is not called safe."""
        outcome = self._metadata.get("outcome")
        if outcome is not None and outcome.get("safe") != "yes":
            return State.NOT_SAFE
        voltage = self._latest.get("voltage_V")
        if not self._has_hv:
            return State.NO_HV if outcome is not None or self._phases else State.UNKNOWN
        if outcome is not None and voltage is not None and abs(voltage) < SAFE_VOLTAGE:
            return State.SAFE  # as measured at the end; the flags of the last sample may be older than that
        if voltage is None or (outcome is None and self.age > OLD_S):
            return State.UNKNOWN
        if max(abs(voltage), abs(self._latest.get("second_V") or 0.0)) >= SAFE_VOLTAGE:
            return State.LIVE
        if HVFlag.ON in self._flags or (self._latest.get("setpoint_V") or 0.0) > 0.0:
            return State.ARMED
        return State.SAFE

    def page(self, seen: dict[str, Any]) -> dict[str, Any]:
        """Everything that the page shows; of the curves what it has not ``seen``: {name: [generation, count]}."""

        def known(name: str) -> tuple[int, int]:
            pair = seen.get(name)
            if isinstance(pair, list) and len(pair) == 2 and all(isinstance(value, int) for value in pair):
                return pair[0], pair[1]
            return -1, 0

        with self._lock:
            outcome = self._metadata.get("outcome")
            return {
                "log": self.path.name,
                "run": self._metadata.get("run", {}),
                "simulated": self.simulated,
                "state": self.state.value,
                "age_s": round(self.age, 2),
                "ended": self._follower.ended,
                "lives": bool(self._said),
                "control": self._said,
                "outcome": outcome,
                "t_s": round(self._t, 2),
                "latest": self._latest,
                "near": self._near(),
                "phase": self._phases[-1] if self._phases else None,
                "phases": len(self._phases),
                "time_left_s": self._time_left(),
                "events": list(self._events),
                "queue": self._queue,
                "error": self._error,
                "traces": {name: trace.since(*known(name)) for name, trace in self._traces.items()},
                "loop": self._loop.since(*known("loop")),
                "outlook": self._outlook if not seen.get("outlook") and self._outlook else None,
            }

    def _near(self) -> list[dict[str, Any]]:
        """Value, limit and share of it, of everything that has a limit; field and tension by the model."""
        limits = (self._outlook or {}).get("limits", {})
        values = {
            name: self._latest.get(name) for name in ("force_mN", "displacement_mm", "voltage_V", "current_uA")
        } | self._film_now()
        found = []
        for name, value in values.items():
            limit = limits.get(name)
            if value is None or limit is None or name == "hoop_stress_kPa":
                continue
            found.append({"name": name, "value": value, "limit": limit, "share": abs(value) / limit if limit else 1.0})
        tension = values.get("hoop_stress_kPa")
        if tension is not None and limits.get("hoop_stress_kPa") is not None:
            found.append(
                {"name": "hoop_stress_kPa", "value": tension, "limit": limits["hoop_stress_kPa"], "share": None}
            )
        return found

    def _film_now(self) -> dict[str, float | None]:
        """Field and least hoop stress of the film now, between the outlook's states (the stress goes with V^2)."""
        film = (self._outlook or {}).get("film")
        h, volts = self._latest.get("displacement_mm"), self._latest.get("voltage_V")
        if not film or h is None or volts is None or not self._phases or not self._phases[-1]["contact"]:
            return {}
        rows = np.array([[np.nan if v is None else v for v in row] for row in film["field_V_per_um"]], dtype=float)
        hoop = np.array([[np.nan if v is None else v for v in row] for row in film["hoop_stress_kPa"]], dtype=float)
        at = [float(np.interp(max(h, 0.0), film["h_mm"], row)) for row in hoop]
        levels = np.array(film["voltages_V"])
        found: dict[str, float | None] = {"hoop_stress_kPa": _finite(float(np.interp(volts**2, levels**2, at)))}
        if levels[-1] > 0:
            top = float(np.interp(max(h, 0.0), film["h_mm"], rows[-1]))
            found["field_V_per_um"] = _finite(top * abs(volts) / levels[-1])
        return found

    def _time_left(self) -> float | None:
        """What the run says; there is no other estimate than its own."""
        said = self._said.get("left_s", "")
        return float(said) if said else None

    def send(self, text: str) -> str:
        """Say a word to the run (stop, pause, continue, or an answer) and give back what it says.

        Raises
        ------
        RigError
            There is no run, or it does not answer.
        """
        try:
            run = live_run(self.path)
            if run.send("status").get("expected") and text.strip().lower() not in (*STOP, *PAUSE, *CONTINUE):
                raise RigError("This is confirmed by typing in the terminal that started the run.")
            return run.send(text, "panel").get("said", "")
        except ConnectionError:
            raise RigError("The run has ended: nobody listens any more.") from None

    def close(self) -> None:
        self._closing.set()
        self._reading.join()  # nobody reads from a file that is closed
        with suppress(OSError):
            self._follower.close()


def _finite(value: float) -> float | None:
    return value if math.isfinite(value) else None
