# Scatter behind a slab by plain Monte Carlo, with xraylib's cross sections: every photon is followed until
# it is absorbed or leaves, and counted where it crosses the detector. For each setup (material, energy,
# thickness, field, side) the mean over the detector as a fraction of the open field's signal, its standard
# error, and the primary.
import numpy as np
import xraylib

WATER = [(1, 0.111898), (8, 0.888102)]
BONE = [(1, 0.034), (6, 0.155), (7, 0.042), (8, 0.435), (11, 0.001), (12, 0.002), (15, 0.103), (16, 0.003)]
BONE += [(20, 0.225)]
MATERIALS = [(WATER, 1.0), (BONE, 1.92)]
PHOTONS = 300_000


def per_m(material, of):
    parts, density = MATERIALS[material]
    return 100 * density * sum(w * of(z) for z, w in parts) / sum(w for _, w in parts)


def counted(material, energy, thickness, field, side):
    rng = np.random.default_rng(1)
    energies = np.geomspace(9, energy, 80)
    coefficients = [
        np.array([per_m(material, lambda z: of(z, e)) for e in energies])
        for of in (xraylib.CS_Photo, xraylib.CS_Compt, xraylib.CS_Rayl)
    ]
    # Inverse cumulative distributions of the cosine, for each energy.
    cosines = np.cos(np.concatenate([np.geomspace(0.01, 0.05, 30), np.linspace(0.06, np.pi - 1e-6, 400)]))[::-1]
    inverse = []
    for of in (xraylib.DCS_Compt, xraylib.DCS_Rayl):
        rows = []
        for e in energies:
            density = np.array([per_m(material, lambda z: of(z, e, np.arccos(c))) for c in cosines])
            total = np.concatenate([[0], np.cumsum((density[1:] + density[:-1]) / 2 * np.diff(cosines))])
            rows.append(np.interp(np.linspace(0, 1, 2001), total / total[-1], cosines))
        inverse.append(np.array(rows))

    # The beam runs along y from the source at 0; photons are uniform on the detector, weighted by angle.
    aim = (rng.random((PHOTONS, 2)) - 0.5) * field
    start = np.stack([aim[:, 0], np.ones(PHOTONS), aim[:, 1]], axis=1)
    length = np.linalg.norm(start, axis=1)
    weight = 1 / length**3
    direction = start / length[:, None]
    near, far = 0.7 - thickness / 2, 0.7 + thickness / 2
    position = direction * (near / direction[:, 1])[:, None]
    e = np.full(PHOTONS, energy)
    number = np.zeros(PHOTONS, int)
    signal = np.zeros(PHOTONS)
    alive = np.arange(PHOTONS)
    primary = np.zeros(PHOTONS)

    def count(who):
        # Photons that left: where they cross the detector, without meeting the slab again.
        d, p = direction[who], position[who]
        t = (1 - p[:, 1]) / d[:, 1]
        x, z = p[:, 0] + t * d[:, 0], p[:, 2] + t * d[:, 2]
        hits = (d[:, 1] > 0) & (np.abs(x) < field / 2) & (np.abs(z) < field / 2)
        # The open field's signal where it arrives.
        there = 1 / (1 + x**2 + z**2) ** 1.5
        share = np.where(hits, weight[who] / there * e[who] / energy, 0)
        scattered = number[who] > 0
        signal[who] = np.where(scattered, share, 0)
        primary[who] = np.where(scattered, 0, share)

    for _ in range(60):
        mu = [np.interp(np.log(e[alive]), np.log(energies), c) for c in coefficients]
        total = sum(mu)
        position[alive] += direction[alive] * (-np.log(rng.random(alive.size)) / total)[:, None]
        p = position[alive]
        inside = (p[:, 1] > near) & (p[:, 1] < far) & (np.abs(p[:, 0]) < side / 2) & (np.abs(p[:, 2]) < side / 2)
        count(alive[~inside])
        alive, mu = alive[inside], [m[inside] for m in mu]
        total = total[inside]
        drawn = rng.random(alive.size) * total
        scatters = drawn >= mu[0]
        is_compton = (drawn < mu[0] + mu[1])[scatters]
        alive = alive[scatters]
        if alive.size == 0:
            break
        u, turn = rng.random(alive.size), rng.random(alive.size) * 2 * np.pi
        row = np.rint(np.interp(np.log(e[alive]), np.log(energies), np.arange(energies.size))).astype(int)
        cosine = np.where(
            is_compton, *[table[row, np.minimum((u * 2000).astype(int), 2000)] for table in inverse]
        )
        e[alive] *= np.where(is_compton, 1 / (1 + e[alive] / 510.99895 * (1 - cosine)), 1)
        number[alive] += 1
        d = direction[alive]
        helper = np.where(np.abs(d[:, :1]) < 0.5, [[1.0, 0, 0]], [[0, 1.0, 0]])
        a = np.cross(d, helper)
        a /= np.linalg.norm(a, axis=1)[:, None]
        b = np.cross(d, a)
        sine = np.sqrt(np.maximum(1 - cosine**2, 0))
        direction[alive] = (
            d * cosine[:, None] + a * (sine * np.cos(turn))[:, None] + b * (sine * np.sin(turn))[:, None]
        )
        keep = e[alive] > energies[0]
        alive = alive[keep]
    return signal.mean(), signal.std() / np.sqrt(PHOTONS), primary.mean()


for setup in SETUPS:
    print(*counted(*setup))
