"""Who the instruments of a run were, as fields of the log: whatever a device calls itself, nothing is parsed."""

from __future__ import annotations

from pathlib import Path

import pytest

from drivers.roles import Identity
from rig.base.clock import VirtualClock
from rig.log.contents import identities_in
from rig.log.reader import read_log
from rig.log.recorder import Gains, Recorder
from rig.log.writer import LogWriter

LABELS = [
    Identity("shvps HVPS 7, serial 3", "", "8"),
    Identity("model A, serial 1, firmware 2; rate=3", "", ""),
    Identity("counted: retries=4", "12, firmware 9", "1; 2"),
    Identity('"quoted", = and\ta tab', "0007", "7.14"),
    Identity("", "", ""),
    Identity("Ω, µ, 漢", "α", "β"),
]


@pytest.mark.parametrize("identity", LABELS, ids=lambda one: one.model)
def test_an_identity_comes_back_as_the_device_stated_it(tmp_path: Path, identity: Identity) -> None:
    path = tmp_path / "a.mcap"
    with LogWriter(path) as log:
        recorder = Recorder(log, VirtualClock(lambda t: None), Gains(), has_laser=False)
        recorder.identity("hv", identity, {"name, serial 5": "a; b"})
        recorder.counters("hv", {"retries": 2})
        log.finish({})
    found = read_log(path)
    assert identities_in(found) == {"hv": identity}
    (setting,) = found.messages("/setting")
    assert (setting.fields["name"], setting.fields["value"]) == ("name, serial 5", "a; b")
    (counter,) = found.messages("/counter")
    assert (counter.fields["device"], counter.fields["name"], counter.fields["count"]) == ("hv", "retries", 2)


@pytest.mark.parametrize(
    ("message", "identity"),
    [
        ("model GSV-8, serial 14209876, firmware 1.16; channel=1, rate=2", Identity("GSV-8", "14209876", "1.16")),
        (
            "model shvps HVPS 7, serial 3, serial , firmware 8; name=HVPS 7, serial 3",
            Identity(LABELS[0].model, "", "8"),
        ),
    ],
)
def test_older_logs_say_it_in_a_sentence(tmp_path: Path, message: str, identity: Identity) -> None:
    path = tmp_path / "a.mcap"
    with LogWriter(path) as log:
        log.write("/event", {"t_s": 0.0, "severity": "info", "source": "hv", "message": message}, 0, 0)
        log.finish({})
    assert identities_in(read_log(path)) == {"hv": identity}
