# Single scatter behind a slab by direct summation, with xraylib's cross sections: for each setup (material,
# energy, thickness, field, side) the mean over the detector and over its middle quarter, as a fraction of the
# open field's signal. The source is 0.7 m before the slab's middle, the detector 1 m from the source.
import numpy as np
import xraylib

WATER = [(1, 0.111898), (8, 0.888102)]
BONE = [(1, 0.034), (6, 0.155), (7, 0.042), (8, 0.435), (11, 0.001), (12, 0.002), (15, 0.103), (16, 0.003)]
BONE += [(20, 0.225)]
MATERIALS = [(WATER, 1.0), (BONE, 1.92)]


def per_m(material, of):
    parts, density = MATERIALS[material]
    return 100 * density * sum(w * of(z) for z, w in parts) / sum(w for _, w in parts)


def single(material, energy, thickness, field, side):
    total = per_m(material, lambda z: xraylib.CS_Total(z, energy))
    # Differential coefficients per metre and steradian over the angle.
    angles = np.concatenate([[0.002], np.linspace(0.01, np.pi, 1500)])
    compton = np.array([per_m(material, lambda z: xraylib.DCS_Compt(z, energy, t)) for t in angles])
    rayleigh = np.array([per_m(material, lambda z: xraylib.DCS_Rayl(z, energy, t)) for t in angles])
    energies = np.geomspace(energy / 2, energy, 100)
    totals = np.array([per_m(material, lambda z: xraylib.CS_Total(z, e)) for e in energies])

    # Detector points at midpoints of 8 x 8 nodes; by symmetry a quarter of them.
    nodes = (np.arange(4) + 0.5) * field / 8
    # Rays to midpoints of n x n parts of the field, in steps along each.
    n, steps = 48, 40
    aim = ((np.arange(n) + 0.5) / n - 0.5) * field
    ax, az = np.meshgrid(aim, aim, indexing="ij")
    length = np.sqrt(ax**2 + az**2 + 1)
    solid_angle = (field / n) ** 2 / length**3
    near, far = 0.7 - thickness / 2, 0.7 + thickness / 2
    values = np.zeros((4, 4))
    for depth in near + (np.arange(steps) + 0.5) / steps * thickness:
        px, pz = ax * depth, az * depth
        inside = (np.abs(px) < side / 2) & (np.abs(pz) < side / 2)
        reaching = solid_angle * length * thickness / steps * np.exp(-total * (depth - near) * length) * inside
        for i, x in enumerate(nodes):
            for j, z in enumerate(nodes):
                dx, dy, dz = x - px, 1 - depth, z - pz
                r = np.sqrt(dx**2 + dy**2 + dz**2)
                cosine = np.clip((dx * ax + dy + dz * az) / (r * length), -1, 1)
                theta = np.maximum(np.arccos(cosine), angles[0])
                # The path leaves through the far face or a side.
                out = np.full_like(r, far - depth)
                for d, p in ((dx, px), (dz, pz)):
                    reach = np.where(d == 0, np.inf, (np.sign(d) * side / 2 - p) / np.where(d == 0, 1, d) * dy)
                    out = np.minimum(out, reach)
                path = out / dy * r
                kept = 1 / (1 + energy / 510.99895 * (1 - cosine))
                after = np.interp(np.log(energy * kept), np.log(energies), totals)
                seen = kept * np.interp(theta, angles, compton) * np.exp(-after * path)
                seen += np.interp(theta, angles, rayleigh) * np.exp(-total * path)
                open_field = 1 / (1 + x**2 + z**2) ** 1.5
                values[i, j] += np.sum(reaching * seen * dy / r**3) / open_field
    return values.mean(), values[:2, :2].mean()


for setup in SETUPS:
    print(*single(*setup))
