//! J-shaped tunnels of a pre-curved tube in foam: drilled radius against the tube's own.

use rayon::prelude::*;

use crate::effort::Effort;

use super::output::{Plan, Table};
use super::rig::{Block, Trial};
use super::tunnel::radius_mm;
use trabecula::failure::Failure;

/// The tool, from published dimensions.
const TOOL: &str = include_str!("../../../configs/tools/ct_sdr.toml");
/// Radius of its tube at rest, mm.
const TUBE_MM: f64 = 69.5;
/// Errors of drilled trajectories: Sharma et al. 2023, arXiv 2305.15304 (abstract), per cent.
const PUBLISHED_PERCENT: [f64; 2] = [1.7, 2.2];
/// Sawbones foams of 5, 10 and 20 PCF, kg/m³; 0 is air.
const FOAMS: [(&str, f64); 4] = [("air", 0.0), ("5 PCF", 80.0), ("10 PCF", 160.0), ("20 PCF", 320.0)];
/// Edge force in N/mm and its exponent: assumptions, as in part 2.
const EDGES: [Option<[f64; 2]>; 2] = [None, Some([7.0, 1.5])];
/// Deployed length, mm.
const DEPLOYED_MM: f64 = 35.0;

pub(super) fn run(plan: &Plan) -> Result<(), Failure> {
    let cases: Vec<_> = FOAMS.iter().flat_map(|foam| EDGES.map(|edge| (*foam, edge))).collect();
    let rows: Vec<Vec<String>> = cases
        .into_par_iter()
        .filter(|((_, density), edge)| *density > 0.0 || edge.is_none())
        .map(|((foam, density), edge)| {
            let [radius_mm, burr_n, walls_n] = tunnel(density, edge, plan.effort)?;
            let percent = (radius_mm / TUBE_MM - 1.0) * 100.0;
            Ok(vec![
                foam.to_owned(),
                edge.map_or_else(String::new, |[force, _]| format!("{force}")),
                format!("{radius_mm:.2}"),
                format!("{percent:.2}"),
                format!("{}-{}", PUBLISHED_PERCENT[0], PUBLISHED_PERCENT[1]),
                format!("{burr_n:.2}"),
                format!("{walls_n:.2}"),
            ])
        })
        .collect::<Result<_, Failure>>()?;
    let mut table = Table::new(&[
        "foam",
        "edge_n_per_mm",
        "radius_mm",
        "error_percent",
        "published_percent",
        "burr_force_max_n",
        "walls_max_n",
    ]);
    rows.into_iter().for_each(|row| table.row(row));
    table.finish(&plan.out, "reproduce-6-j-shape.csv")
}

/// Returns the radius of the burr's path in mm, and the largest forces on the burr and on all walls, N.
fn tunnel(density_kg_per_m3: f64, edge: Option<[f64; 2]>, effort: Effort) -> Result<[f64; 3], Failure> {
    let is_quick = effort == Effort::Quick;
    let voxel_mm = if is_quick { 0.8 } else { 0.4 };
    let block = Block::new([-8.0, -6.0, -10.0], [18.0, 6.0, 44.0], voxel_mm, |_| density_kg_per_m3);
    let trial = Trial {
        dt_ms: if is_quick { 5.0 } else { 2.0 },
        tool: Some(TOOL.to_owned()),
        burr_rpm: 8000.0,
        edge_law: edge,
        ..Trial::new(0.0, if is_quick { 5.0 } else { 1.0 }, DEPLOYED_MM)
    };
    let mut path: Vec<(f64, f64)> = Vec::new();
    let outcome = trial.play(&block, |state, _| {
        let [x, _, z] = state.t_world_burr.position_m.map(|m| m * 1e3);
        if path.last().is_none_or(|last| (last.0 - z).hypot(last.1 - x) > 0.1) {
            path.push((z, x));
        }
    })?;
    Ok([radius_mm(&path), outcome.most_force_n, outcome.most_wall_n])
}

#[cfg(test)]
mod tests {
    use super::*;

    /// In air the burr follows the arc to which the tube is heat-set. Foam holds the tube back: the radius
    /// is larger, by no more than twice the published 2.2 %.
    #[test]
    fn the_tunnel_has_nearly_the_radius_of_the_tube() -> Result<(), Failure> {
        let air_mm = tunnel(0.0, None, Effort::Quick)?[0];
        let foam_mm = tunnel(160.0, None, Effort::Quick)?[0];
        assert!((air_mm / TUBE_MM - 1.0).abs() < 0.02, "{air_mm}");
        assert!((1.0..1.044).contains(&(foam_mm / TUBE_MM)), "{foam_mm}");
        Ok(())
    }
}
