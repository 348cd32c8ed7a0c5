"""The radar chain once more, directly and slowly: NumPy in float64, written from the definitions.

Nothing here is shared with the package under test but its configurations.
"""

import numpy as np

C = 299_792_458.0


def distance(p, antenna):
    return np.linalg.norm(p - np.asarray(antenna, dtype=np.float64), axis=-1)


def wall_terms(wall, frequency, paper=False):
    """(n, G, T0, T1); the paper's T0 and T1 have the propagation phase of the wall in them."""
    n = np.sqrt(wall.relative_permittivity * (1 - 1j * wall.loss_tangent) + 0j)
    d = wall.size_m[1]
    alpha = 2 * np.pi * frequency / C * -n.imag
    g = (1 - n) / (1 + n)
    t12, t21 = 1 + g, 1 - g
    beta = 2 * np.pi * frequency / C * n.real if paper else 0.0
    t0 = t12 * t21 * np.exp(-(alpha + 1j * beta) * d)
    t1 = t12 * g**2 * t21 * np.exp(-3 * (alpha + 1j * beta) * d)
    return n, g, t0, t1


def enters_wall(p, antenna, wall):
    """Whether the segment from antenna to p meets the near face of the slab, point by point."""
    result = np.zeros(p.shape[:-1], dtype=bool)
    y = wall.center_m[1] - wall.size_m[1] / 2
    for index in np.ndindex(*p.shape[:-1]):
        if p[index][1] > y:
            crossing = [np.interp(y, [antenna[1], p[index][1]], [antenna[k], p[index][k]]) for k in (0, 2)]
            inside_x = abs(crossing[0] - wall.center_m[0]) <= wall.size_m[0] / 2
            inside_z = abs(crossing[1] - wall.center_m[2]) <= wall.size_m[2] / 2
            result[index] = inside_x and inside_z
    return result


def path_list(radar, p, wall=None, multipath=False, paper=False):
    """[(delay (M, S), leg 1, leg 2, complex factor of the wave)] of positions p (M, S, 3)."""
    r1, r2 = distance(p, radar.tx_m), distance(p, radar.rx_m)
    if wall is None:
        return [((r1 + r2) / C, r1, r2, np.ones_like(r1))]
    n, g, t0, t1 = wall_terms(wall, radar.carrier_hz, paper)
    d = wall.size_m[1]
    near = wall.center_m[1] - d / 2
    front = p[..., 1] <= near
    tx_in, rx_in = enters_wall(p, radar.tx_m, wall), enters_wall(p, radar.rx_m, wall)
    legs = tx_in.astype(int) + rx_in.astype(int)
    base = (r1 + r2) / C + legs * d * (n.real - 1) / C
    extra = 2 * d * n.real / C
    straight = np.where(tx_in, t0, 1) * np.where(rx_in, t0, 1)
    paths = [(base, r1, r2, straight)]
    if not multipath:
        return paths
    once = np.where(tx_in, t1, 0) * np.where(rx_in, t0, 1)
    once = once + np.where(rx_in, t1, 0) * np.where(tx_in, t0, 1)
    if paper:
        once = np.where(legs == 2, 0, once)
    paths.append((base + extra, r1, r2, once))
    paths.append((base + 2 * extra, r1, r2, np.where(legs == 2, t1**2, 0)))
    tx_image = [radar.tx_m[0], 2 * near - radar.tx_m[1], radar.tx_m[2]]
    rx_image = [radar.rx_m[0], 2 * near - radar.rx_m[1], radar.rx_m[2]]
    i1, i2 = distance(p, tx_image), distance(p, rx_image)
    paths.append(((i1 + r2) / C, i1, r2, np.where(front, g, 0)))
    paths.append(((r1 + i2) / C, r1, i2, np.where(front, g, 0)))
    paths.append(((i1 + i2) / C, i1, i2, np.where(front, g**2, 0)))
    return paths


def slab_matrix(wall, frequency, cos_incidence, polarization):
    """(R, T) of the slab by the characteristic matrix of one layer; T with the phase of the whole passage."""
    n = np.sqrt(wall.relative_permittivity * (1 - 1j * wall.loss_tangent) + 0j)
    cos_inside = np.sqrt(1 - (1 - cos_incidence**2) / n**2)
    outer = cos_incidence if polarization == "te" else 1 / cos_incidence
    inner = n * cos_inside if polarization == "te" else n / cos_inside
    delta = 2 * np.pi * frequency / C * wall.size_m[1] * n * cos_inside
    b = np.cos(delta) + 1j * np.sin(delta) / inner * outer
    c = 1j * inner * np.sin(delta) + np.cos(delta) * outer
    return (outer * b - c) / (outer * b + c), 2 * outer / (outer * b + c)


def interface(permittivity, loss_tangent, cos_incidence, polarization):
    """Fresnel coefficient of the electric field by admittances, from air."""
    n = np.sqrt(permittivity * (1 - 1j * loss_tangent) + 0j)
    cos_inside = np.sqrt(1 - (1 - cos_incidence**2) / n**2)
    outer = cos_incidence if polarization == "te" else 1 / cos_incidence
    inner = n * cos_inside if polarization == "te" else n / cos_inside
    return (outer - inner) / (outer + inner)


def fermat(lateral, air, thickness, index):
    """(cos of incidence, optical length) of the path of least time, by minimisation over the crossing."""
    from scipy.optimize import minimize_scalar

    def length(inside):
        return np.hypot(lateral - inside, air) + index * np.hypot(inside, thickness)

    best = minimize_scalar(length, bounds=(0, max(lateral, 1e-9)), method="bounded", options={"xatol": 1e-10})
    return air / np.hypot(lateral - best.x, air), length(best.x)


def oblique_legs(radar, point, antenna, wall, bounces, polarization):
    """[(length, delay, factor)] of one leg through the wall by 0 ... ``bounces`` pairs of internal bounces."""
    n = np.sqrt(wall.relative_permittivity * (1 - 1j * wall.loss_tangent) + 0j)
    d = wall.size_m[1]
    offset = np.asarray(point, dtype=np.float64) - np.asarray(antenna)
    lateral, r = np.hypot(offset[0], offset[2]), np.linalg.norm(offset)
    cosine, optical = fermat(lateral, offset[1] - d, d, n.real)
    inside = np.sqrt(1 - (1 - cosine**2) / n.real**2)
    k = 2 * np.pi * radar.carrier_hz / C
    loss = np.exp(k * d * (n * np.sqrt(1 - (1 - cosine**2) / n**2)).imag)
    g = interface(wall.relative_permittivity, wall.loss_tangent, cosine, polarization)
    return [
        (r, (optical + 2 * b * d * n.real * inside) / C, (1 - g**2) * g ** (2 * b) * loss ** (2 * b + 1))
        for b in range(bounces + 1)
    ]


def floor_leg(point, antenna, floor, polarization):
    """(length, delay, factor) of one leg by the floor, free space."""
    image = np.array([antenna[0], antenna[1], -antenna[2]])
    offset = np.asarray(point, dtype=np.float64) - image
    r = np.linalg.norm(offset)
    if floor.reflection is not None:
        return r, r / C, floor.reflection
    # ITU-R P.527 for the vertical and the horizontal field over the sine of the grazing angle.
    eps, sine = floor.relative_permittivity * (1 - 1j * floor.loss_tangent), offset[2] / r
    inner, outer = np.sqrt(eps - 1 + sine**2), eps * sine if polarization == "tm" else sine
    return r, r / C, (outer - inner) / (outer + inner)


def pair_legs(radar, out, back):
    """(delays, gains in the IF) of every pair of legs, for 1 m^2; the first of ``out`` with all of ``back``."""
    lam, gain = C / radar.carrier_hz, 10 ** (radar.antenna_gain_dbi / 10)
    delays, gains = [], []
    for r1, t1, f1 in out:
        for r2, t2, f2 in back:
            delays.append(t1 + t2)
            gains.append(np.conj(np.sqrt(gain**2 * lam**2 / ((4 * np.pi) ** 3 * r1**2 * r2**2)) * f1 * f2))
    return np.array(delays), np.array(gains)


def beat(radar, delays, gains):
    """IF (N,) of paths with these delays and gains."""
    mu = radar.bandwidth_hz / radar.chirp_s
    t = np.arange(round(radar.sample_rate_hz * radar.chirp_s)) / radar.sample_rate_hz
    delays, gains = np.asarray(delays)[:, None], np.asarray(gains)[:, None]
    phase = radar.carrier_hz * delays + mu * delays * t - mu * delays**2 / 2
    return (gains * np.exp(2j * np.pi * phase)).sum(0)


def echo(radar, p, rcs, wall=None, multipath=False, paper=False):
    """IF (M, N) of positions (M, S, 3) and rcs (S,) or (M, S), sample by sample."""
    p, rcs = np.asarray(p, dtype=np.float64), np.asarray(rcs, dtype=np.float64)
    mu = radar.bandwidth_hz / radar.chirp_s
    t = np.arange(round(radar.sample_rate_hz * radar.chirp_s)) / radar.sample_rate_hz
    lam = C / radar.carrier_hz
    gain = 10 ** (radar.antenna_gain_dbi / 10)
    out = np.zeros((p.shape[0], t.size), dtype=np.complex128)
    for tau, r1, r2, factor in path_list(radar, p, wall, multipath, paper):
        a = np.sqrt(gain * gain * lam**2 * rcs / ((4 * np.pi) ** 3 * r1**2 * r2**2)) * factor
        for s in range(p.shape[1]):
            delay = tau[:, s, None]
            phase = radar.carrier_hz * delay + mu * delay * t - mu * delay**2 / 2
            out += np.conj(np.broadcast_to(a, tau.shape)[:, s, None]) * np.exp(2j * np.pi * phase)
    return out


def static_path(radar, length, factor):
    """IF (N,) of a path of this length whose wave has this complex amplitude."""
    mu = radar.bandwidth_hz / radar.chirp_s
    t = np.arange(round(radar.sample_rate_hz * radar.chirp_s)) / radar.sample_rate_hz
    tau = length / C
    return np.conj(factor) * np.exp(2j * np.pi * (radar.carrier_hz * tau + mu * tau * t - mu * tau**2 / 2))


def profiles(samples, window="hamming"):
    n = samples.shape[-1]
    w = np.hamming(n) if window == "hamming" else np.ones(n)
    return np.fft.fft(samples * w, axis=-1)[..., : n // 2]


def two_pulse(x):
    return np.diff(x, axis=0)


def doppler_time(x, prf, window_s=0.1, overlap=0.9, paper=False):
    """Map (F, K) and its axis of profiles (M, R), frame by frame."""
    length = round(window_s * prf)
    hop = length - int(np.floor(overlap * length))
    bins = 256
    while bins < length:
        bins *= 2
    window = 0.5 - 0.5 * np.cos(2 * np.pi * np.arange(length) / length)
    y = np.abs(x).sum(axis=1, keepdims=True) if paper else np.conj(x)
    columns = []
    for start in range(0, y.shape[0] - length + 1, hop):
        spectrum = np.fft.fft(y[start : start + length] * window[:, None], bins, axis=0)
        columns.append(np.fft.fftshift(np.sqrt((np.abs(spectrum) ** 2).sum(axis=1))))
    return np.stack(columns, axis=1), np.fft.fftshift(np.fft.fftfreq(bins, 1 / prf))


def relative(actual, expected):
    """Error relative to the reference in the Euclidean norm."""
    expected = np.asarray(expected)
    return float(np.linalg.norm(np.asarray(actual) - expected) / np.linalg.norm(expected))
