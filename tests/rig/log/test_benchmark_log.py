import math

from rig.benchmark import log
from rig.cli.show import show


def test_what_it_measures(tmp_path, capsys):
    report = log.measure(tmp_path, 2.0, 3)
    assert report.messages == 8000 and report.octets > 8000 * 20
    assert 0 < report.sync_ms["median"] <= report.sync_ms["99 %"] <= report.sync_ms["most"]
    times = (report.write_s, report.hand_over_s, report.load_s, *report.damaged_s_per_MiB.values())
    assert all(math.isfinite(seconds) and seconds > 0 for seconds in times)
    assert report.ten_minutes_s == 300 * report.load_s
    assert list(tmp_path.iterdir()) == []  # the logs are gone
    show(log.render(report))
    assert "messages written a second" in capsys.readouterr().out
