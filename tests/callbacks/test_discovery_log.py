"""The share of time that discovery takes, by the clock: it is logged, warned of once, and decides nothing."""

import logging

import pytest

from sb3_options.callbacks.discovery_log import FAR_BEYOND, LONG_ENOUGH, DiscoveryClock
from sb3_options.discovery.discovery import Discovery
from sb3_options.discovery.settings import DiscoverySettings


def warnings_of(share: float, trained: float, caplog: pytest.LogCaptureFixture, max_share: float | None = 0.05) -> int:
    now = [100.0]
    search = Discovery(DiscoverySettings(max_share=max_share))
    search.diary.seconds = 7.0
    clock = DiscoveryClock(7.0, lambda: now[0])
    assert clock.share(search) == 0.0
    caplog.clear()
    with caplog.at_level(logging.WARNING):
        for part in (1, 2):
            now[0] = 100.0 + part * trained
            search.diary.seconds = 7.0 + part * share * trained
            assert clock.share(search) == pytest.approx(share)
    return len(caplog.records)


def test_it_warns_once_where_the_share_is_far_beyond(caplog: pytest.LogCaptureFixture) -> None:
    assert warnings_of(FAR_BEYOND * 0.05 + 0.01, LONG_ENOUGH + 1, caplog) == 1
    assert caplog.records[0].getMessage().startswith("Discovery takes 16 % of the time, 5 % were asked for: ")
    assert warnings_of(0.06, LONG_ENOUGH + 1, caplog) == 0
    assert warnings_of(0.9, LONG_ENOUGH / 3, caplog) == 0
    assert warnings_of(0.9, LONG_ENOUGH + 1, caplog, max_share=None) == 0
