//! Validated ranges of scene values: outside them, random scenes diverge or chatter (`trabecula-lab chart
//! stability --random`, docs/accuracy-physics.md).

use scene::Scene;

use super::{Finding, Verdict};

/// A key and its validated range.
struct Trusted {
    key: &'static str,
    value: fn(&Scene) -> Option<f64>,
    range: [f64; 2],
    outside: &'static str,
}

const STIFFNESS: ([f64; 2], &str) = ([0.05, 1e3], "a tool this soft can diverge under tension");
const MASS: ([f64; 2], &str) = ([0.01, 100.0], "such a tool can chatter at rest");
const DAMPING: ([f64; 2], &str) = ([0.005, 5.0], "such a tool can chatter at rest");
const RATIO: ([f64; 2], &str) = ([0.1, 300.0], "such a tool can diverge under tension");
const CONTACT: ([f64; 2], &str) = ([1e4, 1e8], "such a contact can chatter at rest");

/// `[truth]` overrides the other tables, so both are checked.
const TRUSTED: [Trusted; 12] = [
    trusted("manipulator.stiffness_scale", |scene| scene.manipulator.stiffness_scale, STIFFNESS),
    trusted("manipulator.mass_scale", |scene| scene.manipulator.mass_scale, MASS),
    trusted("manipulator.damping_ratio", |scene| scene.manipulator.damping_ratio, DAMPING),
    trusted("manipulator.lateral_stiffness_ratio", |scene| scene.manipulator.lateral_stiffness_ratio, RATIO),
    trusted("manipulator.torsion_stiffness_ratio", |scene| scene.manipulator.torsion_stiffness_ratio, RATIO),
    trusted("contact.stiffness_n_per_m", |scene| scene.contact.stiffness_n_per_m, CONTACT),
    trusted(
        "truth.manipulator.stiffness_scale",
        |scene| scene.truth.as_ref()?.manipulator.stiffness_scale,
        STIFFNESS,
    ),
    trusted("truth.manipulator.mass_scale", |scene| scene.truth.as_ref()?.manipulator.mass_scale, MASS),
    trusted(
        "truth.manipulator.damping_ratio",
        |scene| scene.truth.as_ref()?.manipulator.damping_ratio,
        DAMPING,
    ),
    trusted(
        "truth.manipulator.lateral_stiffness_ratio",
        |scene| scene.truth.as_ref()?.manipulator.lateral_stiffness_ratio,
        RATIO,
    ),
    trusted(
        "truth.manipulator.torsion_stiffness_ratio",
        |scene| scene.truth.as_ref()?.manipulator.torsion_stiffness_ratio,
        RATIO,
    ),
    trusted(
        "truth.contact.stiffness_n_per_m",
        |scene| scene.truth.as_ref()?.contact.stiffness_n_per_m,
        CONTACT,
    ),
];

const fn trusted(
    key: &'static str,
    value: fn(&Scene) -> Option<f64>,
    (range, outside): ([f64; 2], &'static str),
) -> Trusted {
    Trusted { key, value, range, outside }
}

/// Returns the validated range of a scene key, if it is narrower than the range that a scene accepts.
pub fn validated_range(key: &str) -> Option<[f64; 2]> {
    TRUSTED.iter().find(|trusted| trusted.key == key).map(|trusted| trusted.range)
}

/// Returns a finding for each value outside its validated range.
pub(super) fn findings(scene: &Scene) -> impl Iterator<Item = Finding> {
    TRUSTED.iter().filter_map(|Trusted { key, value, range: [low, high], outside }| {
        let value = value(scene)?;
        let problem = format!("is {value}; expected {low} to {high}: {outside}");
        (!(*low..=*high).contains(&value)).then_some(Finding { verdict: Verdict::Unlikely, key, problem })
    })
}
