//! Other simulators on the chart's beam.
//!
//! Each `NAME.py` in the folder gets `beam.json` and prints one line per measurement: `PROBLEM NAME LINKS
//! DT_MS US_PER_MS LOAD X Z`. In `end_moment` and `tip_force` (LOAD is P L² / EI) X and Z are the tip's rest
//! position, across and along, m; in `vibration` X is the first frequency, Hz.

use crate::effort::Effort;
use std::path::Path;

use serde_json::json;

use super::contact;
use super::elastica::elastica;
use super::problems::{
    BEAM_HZ, DENSITY_KG_PER_M, END_MOMENT_NM, LENGTH_M, Point, Problem, RIGIDITY_NM2, measure as measure_own,
};
use crate::charts::method::Method;
use crate::charts::peers::{new_input, run, scripts};
use simulation::manipulator::{Integrator, Rung};
use trabecula::failure::Failure;

/// Peers with a marker in the figure.
pub const NAMES: [&str; 5] = ["mujoco", "mujoco_cable", "drake", "pybullet", "pyelastica"];
/// The problems that the scripts measure.
const PROBLEMS: [Problem; 3] = [Problem::EndMoment, Problem::TipForce, Problem::Vibration];
/// Our methods for comparison.
const OURS: [Method; 2] = [
    Method::Rung(Rung::Planar, Integrator::LinearlyImplicitEuler),
    Method::Rung(Rung::Planar, Integrator::Hybrid),
];

/// A peer's point.
#[derive(Debug, Clone, PartialEq)]
pub struct Peer {
    /// Problem.
    pub problem: Problem,
    /// Name of the peer.
    pub name: String,
    /// Links or elements.
    pub links: usize,
    /// Step, ms.
    pub dt_ms: f64,
    /// Cost per simulated millisecond, µs.
    pub us_per_ms: f64,
    /// Error in the problem's unit; for `tip_force`, at the worst load.
    pub error: f64,
    /// Its cost divided by that of our cheapest planar setting with no larger error, if there is one; ours is
    /// timed before and after the peer.
    pub cost_ratio: Option<f64>,
}

/// Runs every script. A script that cannot be installed or run is reported, not a failure.
///
/// # Errors
/// No folder of scripts, or a file that cannot be written.
pub fn measure(folder: &Path, out: &Path, effort: Effort) -> Result<Vec<Peer>, Failure> {
    let work = std::path::absolute(out.join("peers-physics"));
    let work = work.map_err(|cause| Failure::failed(format!("{}: {cause}", out.display())))?;
    let input = new_input(&work)?;
    let quick = effort == Effort::Quick;
    let beam = json!({
        "length_m": LENGTH_M,
        "rigidity_nm2": RIGIDITY_NM2,
        "density_kg_per_m": DENSITY_KG_PER_M,
        "end_moment_nm": END_MOMENT_NM,
        "links": if quick { vec![8] } else { vec![8, 13, 26] },
        "loads": if quick { vec![10.0] } else { vec![0.25, 1.0, 2.0, 5.0, 10.0] },
        "vibration_links": 26,
        "dt_ms": [0.1, 0.05],
    });
    output_file::write(&input.path().join("beam.json"), beam.to_string())?;
    let mut all = Vec::new();
    for (name, script) in scripts(folder)?.into_iter().filter(|(name, _)| !name.ends_with(contact::SUFFIX)) {
        let (before, mut peers) = (ours(effort)?, Vec::new());
        match run(&script, &name, &work, input.path()) {
            Err(reason) => say!("peer {name}: not measured ({reason})"),
            Ok(printed) => printed.lines().for_each(|line| collect(line, &mut peers)),
        }
        if peers.is_empty() {
            continue;
        }
        let own = between(before, &ours(effort)?);
        peers.iter_mut().for_each(|peer| compare(peer, &own));
        all.append(&mut peers);
    }
    Ok(all)
}

/// Measures the planar rung on the scripts' problems.
fn ours(effort: Effort) -> Result<Vec<(Problem, Point)>, Failure> {
    let mut points = Vec::new();
    for problem in PROBLEMS {
        for method in OURS {
            let own = measure_own(problem, method, effort);
            let own = own.map_err(|cause| Failure::failed(cause.to_string()))?;
            points.extend(own.into_iter().map(|point| (problem, point)));
        }
    }
    Ok(points)
}

/// Returns the same points, each with the mean of its two costs.
fn between(mut before: Vec<(Problem, Point)>, after: &[(Problem, Point)]) -> Vec<(Problem, Point)> {
    for ((_, first), (_, second)) in before.iter_mut().zip(after) {
        first.us_per_ms = 0.5 * (first.us_per_ms + second.us_per_ms);
    }
    before
}

/// Adds an output line; the loads of one setting become one point. Ignores other lines.
fn collect(line: &str, peers: &mut Vec<Peer>) {
    let words: Vec<&str> = line.split_whitespace().collect();
    let [problem, name, rest @ ..] = words.as_slice() else { return };
    let numbers: Vec<f64> = rest.iter().map_while(|word| word.parse().ok()).collect();
    let [links, dt_ms, us_per_ms, load, x, z] = numbers[..] else { return };
    let distance_um = |exact: [f64; 2]| (x - exact[0]).hypot(z - exact[1]) * 1e6;
    let (problem, error) = match *problem {
        "end_moment" => {
            let bend = END_MOMENT_NM * LENGTH_M / RIGIDITY_NM2;
            let arc = [1.0 - bend.cos(), bend.sin()].map(|share| share * LENGTH_M / bend);
            (Problem::EndMoment, distance_um(arc))
        }
        "tip_force" => (Problem::TipForce, distance_um(elastica(load).map(|share| share * LENGTH_M))),
        "vibration" => (Problem::Vibration, (x / BEAM_HZ - 1.0).abs() * 100.0),
        _ => return,
    };
    let name = (*name).to_owned();
    let point = Peer { problem, name, links: links as usize, dt_ms, us_per_ms, error, cost_ratio: None };
    let same = |other: &&mut Peer| Peer { us_per_ms, error, ..(*other).clone() } == point;
    match peers.iter_mut().find(same) {
        // NaN is the worst error and stays.
        Some(other) if error.is_nan() || other.error < error => *other = point,
        Some(_) => (),
        None => peers.push(point),
    }
}

/// Prints a peer's point, followed by our cheapest one with no larger error.
fn compare(peer: &mut Peer, own: &[(Problem, Point)]) {
    let head = format!(
        "{:<11} {:<19} {:>2} links, dt {:>7} ms: {:>9.2} us/ms, error {:.4}",
        peer.problem.key(),
        peer.name,
        peer.links,
        peer.dt_ms,
        peer.us_per_ms,
        peer.error
    );
    // Euler's numerical damping distorts its frequency, so the vibration problem is compared only with our
    // other integrator.
    let comparable = |problem: Problem, method: Method| problem != Problem::Vibration || method == OURS[1];
    // Two programs that solve the same equations differ by rounding.
    let as_good = own
        .iter()
        .filter(|(problem, own)| *problem == peer.problem && comparable(*problem, own.method))
        .filter(|(_, own)| own.error <= peer.error * 1.01);
    let best = as_good.map(|(_, own)| own).min_by(|a, b| a.us_per_ms.total_cmp(&b.us_per_ms));
    peer.cost_ratio = best.map(|own| peer.us_per_ms / own.us_per_ms);
    match (best, peer.cost_ratio) {
        (Some(own), Some(ratio)) => say!(
            "{head}; {ratio:.2} times our {} with {} links at {} ms, error {:.4}",
            own.method.name(),
            own.links,
            own.dt_ms,
            own.error
        ),
        _ if peer.error.is_finite() => say!("{head}; no setting of ours is as accurate"),
        _ => say!("{head}; lost"),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_peers_lines_become_points_against_the_closed_forms() {
        let mut peers = Vec::new();
        let [x, z] = elastica(10.0).map(|share| share * LENGTH_M);
        for line in [
            "noise".to_owned(),
            format!("tip_force mujoco 8 1.0 5.0 10 {x} {}", z + 2e-6),
            format!("tip_force mujoco 8 1.0 6.0 10 {x} {}", z + 1e-6),
            "vibration mujoco 26 0.1 100 0 nan 0".to_owned(),
            format!("vibration mujoco 26 0.05 100 0 {} 0", 1.01 * BEAM_HZ),
        ] {
            collect(&line, &mut peers);
        }
        assert_eq!(peers.len(), 3);
        assert!((peers[0].error - 2.0).abs() < 1e-6 && peers[0].us_per_ms == 5.0, "{peers:?}");
        assert!(peers[1].error.is_nan() && (peers[2].error - 1.0).abs() < 1e-9);
        // Clamped beam of the chart: 1.8751² / 2 pi sqrt(EI / m) / L², 52.556 Hz.
        assert!((BEAM_HZ - 52.5561).abs() < 1e-3);
    }
}
