"""The CiA 404 driver judged by the canopen package: its node answers our SDOs and packs the PDOs that we asked for."""

from __future__ import annotations

import itertools
import time
from collections.abc import Iterator
from typing import Any

import pytest

canopen = pytest.importorskip("canopen", reason="needs the conformance dependency group")

from canopen import objectdictionary as od  # noqa: E402

from drivers.instruments.cia404.device import CiA404  # noqa: E402
from drivers.links.can_link import CanLink  # noqa: E402
from drivers.links.link import DeviceRefused  # noqa: E402
from drivers.roles import SampleFlag  # noqa: E402

pytestmark = pytest.mark.conformance

NODE = 5
_channels = itertools.count()


def variable(index: int, sub: int, kind: int, value: float, access: str = "rw") -> Any:
    it = od.ODVariable(f"{index:04X}_{sub}", index, sub)
    it.data_type, it.access_type, it.default, it.value = kind, access, value, value
    it.pdo_mappable = True
    return it


def dictionary() -> Any:
    """Object dictionary of a load cell with one analogue input."""
    d = od.ObjectDictionary()
    d.node_id = NODE
    d.add_object(variable(0x1000, 0, od.UNSIGNED32, 0x00020194, "ro"))
    d.add_object(variable(0x1017, 0, od.UNSIGNED16, 0))
    entries = {
        0x1018: [
            (1, od.UNSIGNED32, 0x15F),
            (2, od.UNSIGNED32, 42),
            (3, od.UNSIGNED32, 0x10004),
            (4, od.UNSIGNED32, 77),
        ],
        0x1800: [(1, od.UNSIGNED32, 0x180 + NODE), (2, od.UNSIGNED8, 255), (5, od.UNSIGNED16, 100)],
        0x1A00: [(sub, od.UNSIGNED32, 0) for sub in range(1, 5)],
        0x6125: [(1, od.UNSIGNED32, 0)],
        0x6130: [(1, od.REAL32, 0.0)],
        0x6131: [(1, od.UNSIGNED32, 0x00210000)],
        0x6150: [(1, od.UNSIGNED8, 0)],
    }
    for index, subs in entries.items():
        record = od.ODRecord(f"{index:04X}", index)
        record.add_member(variable(index, 0, od.UNSIGNED8, 0 if index == 0x1A00 else len(subs)))
        for sub, kind, value in subs:
            record.add_member(variable(index, sub, kind, value))
        d.add_object(record)
    return d


class LoadCell:
    """canopen's local node, with the application that canopen leaves to its user: send TPDO1 by event timer."""

    def __init__(self, channel: str) -> None:
        self.network = canopen.Network()
        self.network.connect(interface="virtual", channel=channel)
        self.local = canopen.LocalNode(NODE, dictionary())
        self.network.add_node(self.local)
        self.local.nmt.state = "PRE-OPERATIONAL"
        self.sent = 0
        self.tared: list[int] = []
        self.local.add_write_callback(self._written)
        self._start: float | None = None

    def _written(self, *, index: int, subindex: int, od: Any, data: bytes) -> None:
        if index == 0x6125:
            self.tared.append(int.from_bytes(data, "little"))

    def advance(self, now: float) -> None:
        if self.local.nmt.state != "OPERATIONAL":
            self._start = None
            return
        if self._start is None:
            self._start, self.sent = now, 0
            self.local.tpdo.read()
        while self._start + (self.sent + 1) * self.local.sdo[0x1800][5].raw / 1000 <= now:
            self.sent += 1
            pdo = self.local.tpdo[1]
            pdo[0].raw = 0.001 * self.sent
            pdo[1].raw = 2 if self.sent == 10 else 0
            pdo.transmit()


@pytest.fixture
def cell() -> Iterator[tuple[LoadCell, str]]:
    channel = f"cia404-{next(_channels)}"
    it = LoadCell(channel)
    yield it, channel
    it.network.disconnect()


def test_set_up_stream_and_tare(cell: tuple[LoadCell, str]) -> None:
    load_cell, channel = cell
    link = CanLink("force", "virtual", channel)
    force = CiA404("force", link, node=NODE, rate_Hz=50.0)
    samples = []
    start = time.monotonic()
    while (now := time.monotonic() - start) < 2.0:
        load_cell.advance(now)
        samples += force.poll(now)
        if len(samples) == 20:
            force.set_zero()
        time.sleep(1e-3)
    assert force.identity.serial == "77"
    assert [s.reading for s in samples] == pytest.approx([0.001 * k for k in range(1, len(samples) + 1)])
    assert len(samples) > 60
    assert [k for k, s in enumerate(samples, 1) if s.flags] == [10]
    assert samples[9].flags == SampleFlag.OVER_RANGE
    assert load_cell.tared[:1] == [int.from_bytes(b"zero", "little")]
    assert all(b.t > a.t for a, b in itertools.pairwise(samples))
    link.close()


def test_a_node_of_another_profile_is_refused(cell: tuple[LoadCell, str]) -> None:
    load_cell, channel = cell
    load_cell.local.object_dictionary[0x1000].value = 0x00030191
    link = CanLink("force", "virtual", channel)
    force = CiA404("force", link, node=NODE)
    start = time.monotonic()
    with pytest.raises(DeviceRefused, match="profile 401"):
        while (now := time.monotonic() - start) < 2.0:
            force.poll(now)
            time.sleep(1e-3)
    link.close()
