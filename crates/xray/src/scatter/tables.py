"""Writes tables.rs: interaction coefficients, incoherent scattering functions and form factors of water and of
ICRU-44 cortical bone, from xraylib (BSD licence; T. Schoonjans et al., Spectrochim. Acta B 66 (2011) 776).

    pip install xraylib==4.3.0; python tables.py > tables.rs; rustfmt tables.rs
"""
import xraylib

MATERIALS = [
    ("WATER", [(1, 0.111898), (8, 0.888102)]),
    (
        "CORTICAL_BONE",
        [(1, 0.034), (6, 0.155), (7, 0.042), (8, 0.435), (11, 0.001)]
        + [(12, 0.002), (15, 0.103), (16, 0.003), (20, 0.225)],
    ),
]
ENERGIES, LOWEST_KEV, HIGHEST_KEV = 25, 10.0, 120.0
MOMENTA, LOWEST_PER_ANGSTROM, HIGHEST_PER_ANGSTROM = 73, 0.005, 10.0


def log_steps(low, high, count):
    return [low * (high / low) ** (i / (count - 1)) for i in range(count)]


def per_gram(parts, of):
    return sum(w * of(z) for z, w in parts) / sum(w for _, w in parts)


def array(text, name, values):
    print(f"/// {text}")
    print(f"pub(super) const {name}: [f64; {len(values)}] = [{', '.join(f'{v:.4e}' for v in values)}];\n")


energies = log_steps(LOWEST_KEV, HIGHEST_KEV, ENERGIES)
momenta = log_steps(LOWEST_PER_ANGSTROM, HIGHEST_PER_ANGSTROM, MOMENTA)
print("//! Written by `tables.py` from xraylib 4.3.0; not to be edited.\n")
array("Photon energies, keV, in equal ratios.", "ENERGIES_KEV", energies)
array("Momentum transfers sin(theta/2)/lambda, 1/angstrom, in equal ratios.", "MOMENTA_PER_ANGSTROM", momenta)
for name, parts in MATERIALS:
    for text, of in [
        ("Photoelectric absorption, cm2/g.", xraylib.CS_Photo),
        ("Incoherent scattering, cm2/g.", xraylib.CS_Compt),
        ("Coherent scattering, cm2/g.", xraylib.CS_Rayl),
    ]:
        kind = text.split()[0].upper()
        array(text, f"{name}_{kind}", [per_gram(parts, lambda z: of(z, e)) for e in energies])
    array(
        "Incoherent scattering function, electrons per atomic mass unit.",
        f"{name}_SCATTERING_FUNCTION",
        [per_gram(parts, lambda z: xraylib.SF_Compt(z, x) / xraylib.AtomicWeight(z)) for x in momenta],
    )
    array(
        "Squared form factor per atomic mass unit.",
        f"{name}_SQUARED_FORM_FACTOR",
        [per_gram(parts, lambda z: xraylib.FF_Rayl(z, x) ** 2 / xraylib.AtomicWeight(z)) for x in momenta],
    )
