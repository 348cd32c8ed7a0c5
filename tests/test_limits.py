import math
import re

import pytest

import tensorsim as ts
from tensorsim.limits import RANGES, check_range
from tensorsim.radar.presets import PRESETS


@pytest.mark.parametrize("quantity", RANGES)
def test_both_ends_are_in_and_what_is_beyond_is_out(quantity: str) -> None:
    low, high, unit = RANGES[quantity]
    check_range(low, quantity, "--x")
    check_range(high, quantity, "--x")
    message = re.escape(f"expected {quantity} from {low:g} to {high:g} {unit}")
    for value in (low - 1e-6 * max(1, abs(low)), 1.001 * high + 1, math.nan, math.inf, -math.inf):
        with pytest.raises(ts.TensorsimError, match=f"^--x: got .*{message}$"):
            check_range(value, quantity, "--x")


@pytest.mark.parametrize("name", PRESETS)
def test_presets_are_plausible(name: str) -> None:
    radar = PRESETS[name].radar
    for value, quantity in (
        (radar.carrier_hz, "carrier frequency"),
        (radar.bandwidth_hz, "bandwidth"),
        (radar.chirp_s, "chirp duration"),
        (radar.prf_hz, "pulse repetition frequency"),
        (radar.sample_rate_hz, "sample rate"),
        (radar.samples_per_chirp, "samples per chirp"),
        (radar.antenna_gain_dbi, "gain"),
        (radar.isolation_db, "gain"),
        (len(radar.tx_positions_m) * len(radar.rx_positions_m), "antennas"),
    ):
        check_range(value, quantity, name)
