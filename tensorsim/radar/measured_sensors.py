"""Radars of public data sets of measured people: scenes by name, and the continuous-wave radar by its constants.

Values stated by the makers are marked (S), values that follow from their data (F), typical settings (T).
"""

from tensorsim.config import SPEED_OF_LIGHT_M_S, RadarConfig, SceneConfig

#: RadHAR's point clouds: Doppler bins of 16 chirps and range bins (F).
RADHAR_SPEED_STEP_M_S, RADHAR_RANGE_STEP_M, RADHAR_CHIRPS = 0.6147, 0.0436, 16
_RADHAR_CARRIER_HZ = 77e9
_RADHAR_BANDWIDTH_HZ = SPEED_OF_LIGHT_M_S / (2 * RADHAR_RANGE_STEP_M)

#: Sense2GoL, continuous wave: carrier (S), complex samples per second within a burst, samples of a burst, and time from
#: burst to burst (F).
SENSE2GOL_CARRIER_HZ, SENSE2GOL_SAMPLE_RATE_HZ = 24.125e9, 3000.0
SENSE2GOL_BURST_SAMPLES, SENSE2GOL_BURST_S = 128, 0.2

MEASURED_SENSORS: dict[str, SceneConfig] = {
    # Ancortek radar of the University of Glasgow's "Radar signatures of human activities".
    "glasgow-ancortek": SceneConfig(
        RadarConfig(
            carrier_hz=5.8e9,  # S
            bandwidth_hz=400e6,  # S
            chirp_s=1e-3,  # S
            prf_hz=1000.0,  # S: back-to-back sweeps
            sample_rate_hz=128e3,  # S: 128 samples a sweep
            tx_m=(-0.2, 0.0, 1.0),  # T
            rx_m=(0.2, 0.0, 1.0),
            antenna_gain_dbi=17.0,  # T
            isolation_db=40.0,  # T
        )
    ),
    # TI IWR1443 of RadHAR; frames of 16 chirps, 30 a second.
    "radhar-iwr1443": SceneConfig(
        RadarConfig(
            carrier_hz=_RADHAR_CARRIER_HZ,  # T: 76 to 81 GHz
            bandwidth_hz=_RADHAR_BANDWIDTH_HZ,  # F
            chirp_s=51.2e-6,  # T
            prf_hz=2
            * RADHAR_CHIRPS
            * RADHAR_SPEED_STEP_M_S
            * (_RADHAR_CARRIER_HZ + _RADHAR_BANDWIDTH_HZ / 2)
            / SPEED_OF_LIGHT_M_S,  # F: Doppler bins of lambda PRF / (2 16)
            sample_rate_hz=5e6,  # T
            tx_m=(-0.01, 0.0, 1.0),  # T
            rx_m=(0.01, 0.0, 1.0),
            antenna_gain_dbi=10.0,  # T
            isolation_db=30.0,  # T
        )
    ),
}
