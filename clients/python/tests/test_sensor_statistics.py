"""Statistics of every kind of sensor, with SciPy. `-s` prints the result of each check.

A tool in free space and its arm move for 16 s. Each reading is compared with the measured state:
noise and drift by their Allan deviation, delay by cross-correlation, rate, jitter and drop-outs by their
counts. Every check is then applied to a sensor declared slightly differently, and must reject it.
"""

from __future__ import annotations

from copy import deepcopy
from pathlib import Path
from typing import Any, Callable

import numpy as np
import numpy.typing as npt
import pytest
import support
import trabecula
from trabecula.sim import Sim

signal, stats, transform = support.needs("scipy.signal", "scipy.stats", "scipy.spatial.transform")
Rotation = transform.Rotation

Array = npt.NDArray[np.float64]
Declared = dict[str, Any]

TICKS = 1 << 14
DT_S = 1e-3
#: Probability that a correct sensor fails a check with another seed.
CHANCE = 1e-5
#: Number of runs over which a bias is drawn.
BIASED_RUNS = 40
#: Maximum delay considered, ticks.
MOST_LAG = 60

SENSORS: dict[str, Declared] = {
    "shape": {
        "rate_hz": 200.0,
        "delay_ms": 20.0,
        "fbg": {"nodes": 3, "gauge_mm": 5.0, "noise_per_m": 0.2, "bias_per_m": 0.5},
    },
    "tracker": {
        "rate_hz": 250.0,
        "delay_ms": 30.0,
        "tracker": {"position_noise_mm": 0.3, "orientation_noise_deg": 0.2},
    },
    "joints": {
        "rate_hz": 333.3,
        "delay_ms": 3.0,
        "encoders": {"noise_deg": 0.005, "resolution_deg": 360 / 2**17},
    },
    "tension": {
        "rate_hz": 500.0,
        "delay_ms": 7.0,
        "load_cell": {"noise_n": 0.05, "bias_n": 0.1, "resolution_n": 0.02},
    },
    "wrist": {"rate_hz": 1000.0, "delay_ms": 1.0, "force_torque": {"noise_n": 0.02, "noise_nm": 0.001}},
    "walk": {
        "rate_hz": 500.0,
        "force_torque": {"noise_n": 0.0, "noise_nm": 0.0, "drift_n": 0.01, "drift_nm": 0.002},
    },
    "filtered": {"rate_hz": 1000.0, "force_torque": {"noise_n": 0.0, "noise_nm": 0.0, "low_pass_hz": 50.0}},
    "losses": {"rate_hz": 40.0, "delay_ms": 30.0, "jitter_ms": 8.0, "dropout": 0.1, "seed": 3, "tracker": {}},
}

SCENE = """
name = "sensor_statistics"
[run]
mode = "lockstep"
duration_s = 60.0
seed = 11
[tool]
burr_start_mm = [0.0, 0.0, 0.0]
direction = [1.0, 0.0, 0.0]
bend_toward = [0.0, 0.0, 1.0]
[[controller]]
name = "mover"
drives = ["tendon", "arm", "burr"]
external = true
"""


def toml(value: Any) -> str:
    if isinstance(value, dict):
        return "{ " + ", ".join(f"{key} = {toml(it)}" for key, it in value.items()) + " }"
    return repr(value)


def written_scene(folder: Path) -> Path:
    text = SCENE
    for name, declared in SENSORS.items():
        text += f'[[sensor]]\nname = "{name}"\n' + "".join(
            f"{key} = {toml(value)}\n" for key, value in declared.items()
        )
    (folder / "scene.toml").write_text(text)
    return folder / "scene.toml"


class Seen:
    """The readings of a sensor, and its true values at every tick, (ticks, values)."""

    def __init__(self, readings: list[trabecula.Reading], truth: Array) -> None:
        self.tick = np.array([reading.tick for reading in readings])
        self.sample_tick = np.array([reading.sample_tick for reading in readings])
        self.valid = np.array([reading.valid for reading in readings])
        self.value = np.array([reading.value for reading in readings])
        self.truth = truth

    def error(self) -> Array:
        """Returns the error of each reading relative to the measured state."""
        error: Array = self.value - self.truth[self.sample_tick]
        return error


def pose(raw: Any) -> Array:
    """Returns position, then quaternion x y z w."""
    both: Array = np.concatenate([raw["position_m"], raw["orientation_xyzw"]], axis=-1)
    return both


class Truth:
    """Returns error-free measurements, from the states alone, as defined in docs/sensors.md."""

    def __init__(self) -> None:
        self.rows: dict[str, list[Array]] = {
            name: [] for name in ("burr", "base", "links", "joints", "tension", "wrench")
        }

    def add(self, state: trabecula.State) -> None:
        raw, rows = state.array, self.rows
        rows["burr"].append(pose(raw["t_world_burr"]))
        rows["base"].append(pose(raw["t_world_base"]))
        rows["links"].append(pose(raw["t_world_link"][: state.joint_count]))
        rows["joints"].append(raw["arm_joint_position_rad"][: state.arm_joint_count].copy())
        rows["tension"].append(raw["tendon_tension_n"][: state.tendon_count].copy())
        rows["wrench"].append(
            np.concatenate([raw["flange_wrench"]["force_n"], raw["flange_wrench"]["torque_nm"]])
        )

    def of(self, name: str) -> Array:
        return np.array(self.rows[name])

    def wrench(self) -> Array:
        """Returns force and torque in the axes of the tool's base."""
        to_base, world = Rotation.from_quat(self.of("base")[:, 3:]).inv(), self.of("wrench")
        return np.hstack([to_base.apply(world[:, :3]), to_base.apply(world[:, 3:])])

    def curvature(self, nodes: int, gauge_m: float) -> Array:
        """Returns the mean curvature over the gauge of each node, toward and across: each flexure's rotation
        is spread evenly over the halves of the adjacent links.
        """
        links, base = self.of("links"), self.of("base")
        turns = [Rotation.from_quat(base[:, 3:])] + [
            Rotation.from_quat(links[:, i, 3:]) for i in range(links.shape[1])
        ]
        turned = np.array([(a.inv() * b).as_rotvec() for a, b in zip(turns, turns[1:])])
        gaps_m = np.linalg.norm(np.diff(links[0, :, :3], axis=0), axis=1)
        lengths_m = 0.5 * (np.append(gaps_m[0], gaps_m) + np.append(gaps_m, gaps_m[-1]))
        ends_m = np.concatenate([[0.0], np.cumsum(lengths_m)])
        columns = []
        for node in range(nodes):
            middle_m = (node + 0.5) / nodes * ends_m[-1]
            low, high = (
                np.clip(end, middle_m - gauge_m / 2, middle_m + gauge_m / 2)
                for end in (ends_m[:-1], ends_m[1:])
            )
            shares = (high - low) / lengths_m
            covered_m = (high - low).sum()
            columns += [shares @ turned[:, :, 1] / covered_m, -shares @ turned[:, :, 0] / covered_m]
        return np.array(columns).T


def command(sim_tick: int, start_rad: Array) -> trabecula.Command:
    """Commands chirps: on both tendons to 18 Hz, on the arm's joints to 4 Hz."""
    t, end_s = sim_tick * DT_S, TICKS * DT_S
    made = trabecula.Command()
    made.tendon_mode = trabecula.TendonMode.SERVO_JF
    made.tendon_force_n[0] = 4.0 + 3.5 * float(signal.chirp(t, 1.0, end_s, 18.0))
    made.tendon_force_n[1] = 1.0 + 0.5 * float(signal.chirp(t, 2.0, end_s, 13.0))
    made.arm_mode = trabecula.ArmMode.SERVO_JP
    made.arm_joint_position_rad = start_rad + 0.01 * float(signal.chirp(t, 0.5, end_s, 4.0, phi=90.0))
    return made


def run(scene: Path) -> dict[str, Seen]:
    """Returns the readings of every sensor, and the truth."""
    sim = Sim(scene)
    truth, readings = Truth(), list(sim.readings())
    truth.add(sim.state)
    start_rad = np.array(sim.state.arm_joint_position_rad)
    for tick in range(TICKS):
        truth.add(sim.step(command(tick, start_rad)))
        readings += sim.readings()
    shape = SENSORS["shape"]["fbg"]
    exact = {
        "shape": truth.curvature(shape["nodes"], 1e-3 * shape["gauge_mm"]),
        "tracker": truth.of("burr"),
        "joints": truth.of("joints"),
        "tension": truth.of("tension"),
        "losses": truth.of("burr"),
        **dict.fromkeys(("wrist", "walk", "filtered"), truth.wrench()),
    }
    return {
        name: Seen([reading for reading in readings if reading.sensor_index == index], exact[name])
        for index, name in enumerate(SENSORS)
    }


def allan_variance(x: Array, m: int) -> float:
    """Returns the overlapping Allan variance of means over m values (Riley and Howe 2008, NIST SP 1065,
    section 5.2.4).
    """
    sums = np.concatenate([[0.0], np.cumsum(x)])
    means = (sums[m:] - sums[:-m]) / m
    return float(0.5 * np.mean((means[m:] - means[:-m]) ** 2))


def freedom(samples: int, m: int, is_walk: bool) -> float:
    """Returns the degrees of freedom of the overlapping estimate (ibid., table 5: white FM, random walk
    FM).
    """
    n = samples + 1
    if is_walk:
        return (n - 2) / m * ((n - 1) ** 2 - 3 * m * (n - 1) + 4 * m**2) / (n - 3) ** 2
    return (3 * (n - 1) / (2 * m) - 2 * (n - 2) / n) * 4 * m**2 / (4 * m**2 + 5)


def allan(x: Array, sigma: float, period_s: float, *, walk: float = 0.0) -> str:
    """Compares the Allan variance of independent channels (samples, channels) with that of white noise, or of
    a random walk of `walk` per root second: σ²/m, and K² T (2m² + 1)/(6m), which is K² τ/3 at long times. The
    interval
    is that of χ² over all channels.
    """
    samples, channels = x.shape
    octaves = [1 << i for i in range(20) if (1 << i) <= samples // 16]
    found = []
    for m in octaves:
        variance = float(np.mean([allan_variance(x[:, i], m) for i in range(channels)]))
        law = walk**2 * period_s * (2 * m**2 + 1) / (6 * m) if walk else sigma**2 / m
        degrees = channels * freedom(samples, m, bool(walk))
        low, high = (stats.chi2.ppf(p, degrees) / degrees for p in (CHANCE / 2, 1 - CHANCE / 2))
        assert low < variance / law < high, (
            f"m = {m}: Allan variance {variance} against {law}, allowed {low} to {high} of it"
        )
        found.append((m * period_s, np.sqrt(variance), np.sqrt(low), np.sqrt(high), np.sqrt(variance / law)))
    first, last = found[0], found[-1]
    # For a random walk, start where sampling is no longer visible.
    line = found[3:] if walk else found
    slope = stats.linregress(np.log([it[0] for it in line]), np.log([it[1] for it in line])).slope
    return (
        f"{first[4]:.3f} of the law at {first[0] * 1e3:.3g} ms ({first[2]:.3f} to {first[3]:.3f}), "
        f"{last[4]:.2f} at {last[0]:.2g} s "
        f"({last[2]:.2f} to {last[3]:.2f}), slope {slope:+.2f}"
    )


def rounded(sigma: float, step: float) -> float:
    """Returns the deviation of normal noise rounded to steps of at most twice its deviation (Sheppard)."""
    return float(np.hypot(sigma, step / np.sqrt(12)))


def period_s(declared: Declared) -> float:
    return 1 / float(declared["rate_hz"])


def noise_of_shape(seen: Seen, declared: Declared) -> str:
    return allan(seen.error(), declared["fbg"]["noise_per_m"], period_s(declared))


def noise_of_position(seen: Seen, declared: Declared) -> str:
    return allan(seen.error()[:, :3], 1e-3 * declared["tracker"]["position_noise_mm"], period_s(declared))


def noise_of_orientation(seen: Seen, declared: Declared) -> str:
    true, read = (Rotation.from_quat(pose[:, 3:]) for pose in (seen.truth[seen.sample_tick], seen.value))
    return allan(
        (true.inv() * read).as_rotvec(),
        np.radians(declared["tracker"]["orientation_noise_deg"]),
        period_s(declared),
    )


def noise_of_joints(seen: Seen, declared: Declared) -> str:
    sigma, step = (np.radians(declared["encoders"][key]) for key in ("noise_deg", "resolution_deg"))
    assert np.allclose(seen.value / step, np.round(seen.value / step), rtol=0, atol=1e-6), (
        "no multiple of the resolution"
    )
    return allan(seen.error(), rounded(sigma, step), period_s(declared))


def noise_of_tension(seen: Seen, declared: Declared) -> str:
    sigma, step = (declared["load_cell"][key] for key in ("noise_n", "resolution_n"))
    assert np.allclose(seen.value / step, np.round(seen.value / step), rtol=0, atol=1e-6), (
        "no multiple of the resolution"
    )
    return allan(seen.error(), rounded(sigma, step), period_s(declared))


def noise_of_force(seen: Seen, declared: Declared) -> str:
    return allan(seen.error()[:, :3], declared["force_torque"]["noise_n"], period_s(declared))


def noise_of_torque(seen: Seen, declared: Declared) -> str:
    return allan(seen.error()[:, 3:], declared["force_torque"]["noise_nm"], period_s(declared))


def drift_of_force(seen: Seen, declared: Declared) -> str:
    return allan(seen.error()[:, :3], 0.0, period_s(declared), walk=declared["force_torque"]["drift_n"])


def drift_of_torque(seen: Seen, declared: Declared) -> str:
    return allan(seen.error()[:, 3:], 0.0, period_s(declared), walk=declared["force_torque"]["drift_nm"])


def low_pass(seen: Seen, declared: Declared) -> str:
    share = 1 - np.exp(-2 * np.pi * declared["force_torque"]["low_pass_hz"] * DT_S)
    start = (1 - share) * seen.truth[:1]
    law, _ = signal.lfilter([share], [1, share - 1], seen.truth, axis=0, zi=start)
    worst = float(np.max(np.abs(seen.value - law[seen.sample_tick])))
    assert worst < 1e-12, f"{worst} off scipy.signal.lfilter"
    return f"within {worst:.1e} N or N m of scipy.signal.lfilter"


def delay(seen: Seen, declared: Declared) -> str:
    """Finds the lag at which readings correlate best with the truth: Pearson's coefficient over all lags,
    computed by FFT.
    """
    gain = seen.truth[seen.sample_tick].std(axis=0) / seen.error().std(axis=0)
    channel = int(np.argmax(gain))
    x = seen.truth[:, channel] - seen.truth[:, channel].mean()
    used = seen.valid & (seen.tick >= MOST_LAG)
    y, arrived = np.zeros_like(x), np.zeros_like(x)
    y[seen.tick[used]] = seen.value[used, channel] - seen.value[used, channel].mean()
    arrived[seen.tick[used]] = 1.0
    lags = signal.correlation_lags(len(x), len(x))
    within = (lags >= 0) & (lags <= MOST_LAG)
    product, sums, squares = (
        signal.correlate(a, b, method="fft")[within] for a, b in ((y, x), (arrived, x), (arrived, x**2))
    )
    count = used.sum()
    coefficient = product / np.sqrt((squares - sums**2 / count) * np.sum(y**2))
    lag = int(lags[within][np.argmax(coefficient)])
    wanted = (declared.get("delay_ms", 0.0) + declared.get("jitter_ms", 0.0) / 2) / (DT_S * 1e3)
    allowed = 0.5 if "jitter_ms" not in declared else 0.5 * period_s(declared) / DT_S
    assert abs(lag - wanted) <= allowed, (
        f"the cross-correlation is greatest at {lag} ticks, declared are {wanted}"
    )
    return f"greatest at {lag} ms (coefficient {coefficient.max():.4f})"


def rate(seen: Seen, declared: Declared) -> str:
    numbers = np.arange(len(seen.sample_tick))
    due = np.ceil(numbers / (declared["rate_hz"] * DT_S) - 1e-6).astype(int)
    assert np.array_equal(seen.sample_tick, due), f"samples at {seen.sample_tick[:9]}, due at {due[:9]}"
    late = (
        (TICKS - declared.get("delay_ms", 0.0) - declared.get("jitter_ms", 0.0)) * DT_S * declared["rate_hz"]
    )
    assert len(numbers) >= int(late), f"{len(numbers)} readings"
    return f"{len(numbers)} samples, each at its tick"


def jitter(seen: Seen, declared: Declared) -> str:
    """Uniformly drawn and rounded to ticks: the first and the last tick have half the probability of the
    others.
    """
    later = seen.tick - seen.sample_tick - round(declared["delay_ms"])
    ticks = round(declared["jitter_ms"])
    assert later.min() >= 0 and later.max() <= ticks, f"{later.min()} to {later.max()} ticks"
    shares = np.full(ticks + 1, 1 / ticks)
    shares[[0, -1]] /= 2
    test = stats.chisquare(np.bincount(later, minlength=ticks + 1), shares * len(later))
    assert test.pvalue > CHANCE, f"chi-square {test.statistic}, p = {test.pvalue}"
    return f"0 to {later.max()} ms, chi-square p = {test.pvalue:.2f} of {len(later)}"


def drop_outs(seen: Seen, declared: Declared) -> str:
    lost, count = int(np.sum(~seen.valid)), len(seen.valid)
    low, high = stats.binomtest(lost, count, declared["dropout"]).proportion_ci(1 - CHANCE)
    assert low <= declared["dropout"] <= high, f"{lost} of {count} lost: {low} to {high}"
    assert not np.any(seen.value[~seen.valid]), "a reading that dropped out has values"
    return f"{lost} of {count} lost, interval {low:.3f} to {high:.3f}"


def biases(scene: Path, name: str) -> tuple[Array, int]:
    """Returns the mean error of every value in runs with other seeds, and its number of readings."""
    found, count = [], 0
    index = list(SENSORS).index(name)
    for seed in range(BIASED_RUNS):
        sim = Sim(scene, seed=seed)
        truth, readings = Truth(), list(sim.readings())
        truth.add(sim.state)
        for _ in range(60):
            truth.add(sim.step())
            readings += sim.readings()
        shape = SENSORS["shape"]["fbg"]
        exact = (
            truth.curvature(shape["nodes"], 1e-3 * shape["gauge_mm"])
            if name == "shape"
            else truth.of("tension")
        )
        seen = Seen([reading for reading in readings if reading.sensor_index == index], exact)
        count = len(seen.tick)
        found += list(seen.error().mean(axis=0))
    return np.array(found), count


def bias(found: tuple[Array, int], sigma: float, noise: float) -> str:
    values, count = found
    law = float(np.hypot(sigma, noise / np.sqrt(count)))
    low, high = (np.sqrt(stats.chi2.ppf(p, len(values)) / len(values)) for p in (CHANCE / 2, 1 - CHANCE / 2))
    ratio = float(np.sqrt(np.mean(values**2)) / law)
    assert low < ratio < high, f"deviation of the bias is {ratio} of the law, allowed {low} to {high}"
    test = stats.kstest(values / law, "norm")
    assert test.pvalue > CHANCE, f"not normal: p = {test.pvalue}"
    interval = f"({low:.2f} to {high:.2f})"
    return f"{ratio:.3f} of the law {interval}, normal with p = {test.pvalue:.2f} of {len(values)}"


Check = Callable[[Seen, Declared], str]

#: Sensor, name and check; then the key that is declared differently at the end, by a factor and an offset.
CHECKS: list[tuple[str, str, Check, tuple[str, ...], float, float]] = [
    ("shape", "noise", noise_of_shape, ("fbg", "noise_per_m"), 1.05, 0.0),
    ("tracker", "noise of place", noise_of_position, ("tracker", "position_noise_mm"), 1.05, 0.0),
    ("tracker", "noise of direction", noise_of_orientation, ("tracker", "orientation_noise_deg"), 1.05, 0.0),
    ("joints", "noise", noise_of_joints, ("encoders", "noise_deg"), 1.05, 0.0),
    ("tension", "noise", noise_of_tension, ("load_cell", "noise_n"), 1.05, 0.0),
    ("wrist", "noise of force", noise_of_force, ("force_torque", "noise_n"), 1.05, 0.0),
    ("wrist", "noise of torque", noise_of_torque, ("force_torque", "noise_nm"), 1.05, 0.0),
    ("walk", "drift of force", drift_of_force, ("force_torque", "drift_n"), 1.05, 0.0),
    ("walk", "drift of torque", drift_of_torque, ("force_torque", "drift_nm"), 1.05, 0.0),
    ("filtered", "low pass", low_pass, ("force_torque", "low_pass_hz"), 1.001, 0.0),
    *(
        (name, "delay", delay, ("delay_ms",), 1.0, 1.0)
        for name in ("shape", "tracker", "joints", "tension", "wrist")
    ),
    *((name, "rate", rate, ("rate_hz",), 1.001, 0.0) for name in SENSORS),
    ("losses", "jitter", jitter, ("jitter_ms",), 1.0, 1.0),
    ("losses", "drop-outs", drop_outs, ("dropout",), 1.8, 0.0),
]


def otherwise(declared: Declared, path: tuple[str, ...], factor: float, more: float) -> Declared:
    changed = deepcopy(declared)
    table = changed
    for key in path[:-1]:
        table = table[key]
    table[path[-1]] = table[path[-1]] * factor + more
    return changed


@pytest.fixture(scope="module")
def scene(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return written_scene(tmp_path_factory.mktemp("sensors"))


@pytest.fixture(scope="module")
def seen(scene: Path) -> dict[str, Seen]:
    return run(scene)


@pytest.mark.parametrize(
    ("name", "what", "check", "path", "factor", "more"), CHECKS, ids=[f"{c[0]}-{c[1]}" for c in CHECKS]
)
def test_a_sensor_is_as_declared_and_not_otherwise(
    name: str,
    what: str,
    check: Check,
    path: tuple[str, ...],
    factor: float,
    more: float,
    seen: dict[str, Seen],
) -> None:
    declared = SENSORS[name]
    print(f"{name:<9} {what:<18} {check(seen[name], declared)}")
    with pytest.raises(AssertionError):
        check(seen[name], otherwise(declared, path, factor, more))


@pytest.mark.parametrize(("name", "kind", "unit"), [("shape", "fbg", "per_m"), ("tension", "load_cell", "n")])
def test_a_bias_is_drawn_as_declared(name: str, kind: str, unit: str, scene: Path) -> None:
    found = biases(scene, name)
    sigma, noise = SENSORS[name][kind][f"bias_{unit}"], SENSORS[name][kind][f"noise_{unit}"]
    print(f"{name:<9} {'bias':<18} {bias(found, sigma, noise)}")
    with pytest.raises(AssertionError):
        bias(found, 1.6 * sigma, noise)
