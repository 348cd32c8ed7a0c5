"""Where each equation of the paper is: topic, formula, function and test.

The paper is "RadHARSimulator V2: Video to Doppler Generator" (arXiv 2511.09022). Rows follow its order, under the names
of its two modules and of its recognition network, and are named by topic instead of equation number. Where the
default here differs from the paper, the formula is the paper's, and the function offers it as an option.
"""

from typing import NamedTuple


class Equation(NamedTuple):
    """A row of the table.

    Attributes:
        topic: what the equation is about, in the paper's terms.
        formula: the equation in plain text.
        function: dotted path of the function or class that computes it.
        test: file and function of a test that covers it.
    """

    topic: str
    formula: str
    function: str
    test: str


#: The paper's computer vision module, its radar module, and its recognition network.
EQUATIONS = {
    "Computer vision module": (
        Equation(
            "detection by RTMDet",
            "box = (u - l, v - t, u + r, v + b), score = sigmoid(logit)",
            "tensorsim.vision.RTMDet",
            "tests/vision/detection/test_rtmdet.py::test_select_decodes_one_cell",
        ),
        Equation(
            "global nearest neighbour tracking, Hungarian assignment",
            "minimise the sum of cost(i, j) over matched pairs",
            "tensorsim.vision.tracking.assignment.assign",
            "tests/vision/tracking/test_assignment.py::test_thousands_of_random_matrices_cost_as_little_as_scipys",
        ),
        Equation(
            "confirmation and deletion of tracks",
            "confirmed by 2 hits of 5, deleted after 23 misses of 23",
            "tensorsim.vision.GNNTracker",
            "tests/vision/tracking/test_tracker.py::test_coasting_ends_after_the_misses_of_the_panel",
        ),
        Equation(
            "2D pose by HRNet",
            "joint = position of the maximum of its heat map, moved a quarter pixel towards the second",
            "tensorsim.vision.pose2d.heatmaps.decode_quarter",
            "tests/vision/pose2d/test_heatmaps.py::test_equals_the_definition",
        ),
        Equation(
            "3D pose by nearest matching",
            "normalised 2D pose -> nearest pose of a 3D library",
            "tensorsim.vision.NearestPoseLifter",
            "tests/vision/lifting/test_pose_search.py::"
            "test_equal_weights_give_the_nearest_neighbours_of_normalised_poses",
        ),
        Equation(
            "scale of a person in metres per pixel",
            "alpha = person height / pixel height",
            "tensorsim.vision.lifting.metric_pose.metres_per_pixel",
            "tests/vision/lifting/test_metric_pose.py::test_papers_position_adds_pixels_times_alpha_at_constant_range",
        ),
        Equation(
            "position in metres",
            "x(t) = x(t - 1) + alpha(t) (u(t) - u(t - 1)), u the hip centre in pixels",
            "tensorsim.vision.lifting.metric_pose.accumulated_displacement",
            "tests/vision/lifting/test_metric_pose.py::"
            "test_papers_position_stays_where_the_hips_stay_while_the_scale_changes",
        ),
        Equation(
            "Kalman filter with constant velocity, prediction",
            "x = F x, P = F P F' + Q",
            "tensorsim.vision.smoothing.kalman.constant_velocity_predict",
            "tests/vision/smoothing/test_kalman.py::test_equals_filterpy",
        ),
        Equation(
            "Kalman filter with constant velocity, update",
            "K = P H' / (H P H' + r), x = x + K (z - H x), P = (1 - K H) P",
            "tensorsim.vision.smoothing.kalman.kalman_update",
            "tests/vision/smoothing/test_kalman.py::test_equals_filterpy",
        ),
    ),
    "Radar module": (
        Equation(
            "interpolation of poses to the PRF",
            "linear between video frames",
            "tensorsim.motion.PoseResampler",
            "tests/motion/test_resample.py::test_linear_equals_numpy",
        ),
        Equation(
            "Savitzky-Golay smoothing",
            "least-squares polynomial in a sliding window",
            "tensorsim.motion.SavitzkyGolay",
            "tests/motion/test_savgol.py::test_equals_scipy_from_end_to_end",
        ),
        Equation(
            "delay model in free space",
            "tau = (|P - Tx| + |P - Rx|) / c",
            "tensorsim.radar.synthesis.paths.PropagationPaths",
            "tests/radar/synthesis/test_wall_and_paths.py::test_worked_case_of_a_target_in_front_of_a_wall",
        ),
        Equation(
            "radar equation",
            "a = sqrt(Gt Gr lambda^2 sigma / ((4 pi)^3 R1^2 R2^2))",
            "tensorsim.radar.radar_equation_amplitude",
            "tests/radar/synthesis/test_wall_and_paths.py::test_radar_equation_amplitude",
        ),
        Equation(
            "dechirp, intermediate frequency (IF)",
            "IF(t) = sum of conj(a) exp(j 2 pi (fc tau + mu tau t - mu tau^2 / 2))",
            "tensorsim.radar.intermediate_frequency",
            "tests/radar/synthesis/test_echo.py::test_intermediate_frequency",
        ),
        Equation(
            "leakage of the transmitter",
            "a = 10^(-isolation / 20), tau = |Tx - Rx| / c",
            "tensorsim.radar.EchoSynthesizer",
            "tests/radar/synthesis/test_echo.py::test_leakage_and_wall_echo_equal_their_definitions",
        ),
        Equation(
            "attenuation in the wall",
            "n = sqrt(eps_r (1 - j tan d)) = n' - j n'', alpha = (2 pi f / c) n''",
            "tensorsim.radar.synthesis.wall.slab_coefficients",
            "tests/radar/synthesis/test_wall_and_paths.py::test_through_wall_terms",
        ),
        Equation(
            "reflection at the wall face",
            "Gamma = (1 - n) / (1 + n)",
            "tensorsim.radar.synthesis.wall.fresnel",
            "tests/radar/synthesis/test_wall_physics.py::test_fresnel_brewster_normal_and_signs",
        ),
        Equation(
            "one-way transmission of the wall",
            "T_k = T12 T21 Gamma^(2k) exp(-(2k + 1) (alpha + j beta) d)",
            "tensorsim.radar.synthesis.wall.paper_transmission",
            "tests/radar/synthesis/test_wall_and_paths.py::test_literal_paper_formula",
        ),
        Equation(
            "two-way transmission of the wall",
            "T0^2 and T1^2 (the default adds 2 T0 T1, and has the phase in the delay alone)",
            "tensorsim.radar.two_way_wall_transmission",
            "tests/radar/synthesis/test_wall_and_paths.py::test_two_way_wall_transmission",
        ),
        Equation(
            "mirror method",
            "tau_a, tau_b, tau_c: Tx' - P - Rx, Tx - P - Rx', Tx' - P - Rx'",
            "tensorsim.radar.mirror_delays",
            "tests/radar/synthesis/test_wall_and_paths.py::test_mirror_delays",
        ),
        Equation(
            "receiver noise",
            "noise power = signal power / 10^(SNR / 10)",
            "tensorsim.radar.ReceiverNoise",
            "tests/radar/synthesis/test_noise.py::test_noise_variance_per_reference",
        ),
        Equation(
            "pulse compression, range-time map (RTM)",
            "RTM = |FFT over fast time of IF|, range = k c / (2 B)",
            "tensorsim.radar.range_profile",
            "tests/radar/processing/test_range_profile_and_mti.py::test_profile_equals_numpy",
        ),
        Equation(
            "moving target indication (MTI)",
            "y[m] = x[m + 1] - x[m]",
            "tensorsim.radar.two_pulse_canceller",
            "tests/radar/processing/test_mti.py::test_two_pulse_canceller_is_the_difference",
        ),
        Equation(
            "denoising by DnCNN",
            "clean = y - Q(y)",
            "tensorsim.enhance.DnCNN",
            "tests/enhance/test_dncnn.py::test_output_is_the_image_less_its_noise",
        ),
        Equation(
            "training of DnCNN",
            "loss = 1/2 mean |Q(y) - (y - x)|^2",
            "tensorsim.training.denoiser.DenoiserRecipe",
            "tests/training/test_denoiser.py::test_loss_is_half_the_error_of_the_residual",
        ),
        Equation(
            "Doppler-time map (DTM) by short-time Fourier transform",
            "DTM = sqrt(sum over range bins of |STFT of the bin|^2)",
            "tensorsim.radar.doppler_time_map",
            "tests/radar/processing/test_doppler.py::test_blocks_equal_the_formula",
        ),
        Equation(
            "the paper's integration over range, without the sign of Doppler",
            "DTM = |STFT of the sum over range bins of |x||",
            "tensorsim.radar.DopplerTimeMap",
            "tests/radar/processing/test_doppler.py::test_map_equals_loop_over_frames",
        ),
        Equation(
            "ridges by maximum local energy",
            "the N_r largest local maxima along Doppler of each frame",
            "tensorsim.radar.RidgeExtractor",
            "tests/radar/processing/test_ridges.py::test_peaks_equal_scipy",
        ),
    ),
    "Recognition network": (
        Equation(
            "SPNet, parallel-serial blocks",
            "p_i = conv(conv(y)), q_i = conv(p_i), six branches fused by a 1x1 convolution",
            "tensorsim.recognition.SPNet",
            "tests/recognition/test_spnet.py::test_six_branches_side_by_side",
        ),
    ),
}


def table() -> str:
    """The equations as text: under each heading a list of topic, formula, function and test."""
    lines = []
    for heading, equations in EQUATIONS.items():
        lines += ["", heading]
        for row in equations:
            lines += [f"- {row.topic}: ``{row.formula}``", f"  -> `{row.function}`", f"  -> ``{row.test}``"]
    return "\n".join(lines)
