//! Draws the tool over the anatomy, row by row.

use crate::carm::{CArm, PixelBox};
use crate::error::DrrError;
use crate::ray::{IndexRay, RayFan};
use crate::removal::AttenuationField;
use crate::renderer::Projector;
use crate::tool::{PreparedPart, Tool, join_intervals};
use crate::{joseph, siddon};

/// A part, its attenuation at the frame's energy, and the pixels that it can cover.
pub(crate) struct PlacedPart {
    part: PreparedPart,
    mu_per_m: f64,
    bounds: PixelBox,
}

/// The parts of the tool that the C-arm sees, in the tool's order.
pub(crate) fn place(tool: &Tool, c_arm: &CArm, energy_kev: f64) -> Result<Vec<PlacedPart>, DrrError> {
    let pinhole = c_arm.pinhole();
    let mut placed = Vec::with_capacity(tool.parts.len());
    for part in tool.prepare()? {
        let mu_per_m = part.material().mu_per_m(energy_kev)?;
        if let Some(bounds) = part.bounds(&pinhole, c_arm.columns, c_arm.rows) {
            placed.push(PlacedPart { part, mu_per_m, bounds });
        }
    }
    Ok(placed)
}

/// First row that a part can cover, and one past the last.
pub(crate) fn row_span(placed: &[PlacedPart]) -> (u32, u32) {
    let first = placed.iter().map(|p| p.bounds.rows.0).min().unwrap_or(0);
    let end = placed.iter().map(|p| p.bounds.rows.1).max().unwrap_or(0);
    (first, end)
}

/// What drawing a row of the tool needs.
pub(crate) struct ToolLayer<'a> {
    pub(crate) projector: Projector,
    pub(crate) field: &'a AttenuationField<'a>,
    pub(crate) fan: &'a RayFan,
    pub(crate) placed: &'a [PlacedPart],
}

impl ToolLayer<'_> {
    /// Corrects one row of the image; returns how many pixels the tool covers.
    pub(crate) fn draw_row(&self, row: u32, total: &mut [f64], metal: &mut [f64]) -> usize {
        let in_row: Vec<&PlacedPart> =
            self.placed.iter().filter(|p| (p.bounds.rows.0..p.bounds.rows.1).contains(&row)).collect();
        let first = in_row.iter().map(|p| p.bounds.columns.0).min().unwrap_or(0);
        let end = in_row.iter().map(|p| p.bounds.columns.1).max().unwrap_or(0);
        let mut envelopes = Vec::with_capacity(in_row.len());
        let mut covered = 0;
        for column in first..end {
            let ray = self.fan.world_ray(column, row);
            envelopes.clear();
            let mut metal_integral = 0.0;
            for p in in_row.iter().filter(|p| (p.bounds.columns.0..p.bounds.columns.1).contains(&column)) {
                if let Some(crossing) = p.part.cross(&ray) {
                    envelopes.push(crossing.envelope);
                    metal_integral += p.mu_per_m * crossing.metal_m;
                }
            }
            if envelopes.is_empty() {
                continue;
            }
            covered += 1;
            let joined = join_intervals(&mut envelopes);
            let index_ray = self.fan.index_ray(column, row);
            let mut anatomy = total[column as usize];
            for &range in &envelopes[..joined] {
                anatomy -= self.displaced(&index_ray, range);
            }
            // What is left of a fully displaced anatomy may be a rounding error below 0.
            total[column as usize] = anatomy.max(0.0) + metal_integral;
            metal[column as usize] = metal_integral;
        }
        covered
    }

    /// Anatomy between two parameters of a ray.
    fn displaced(&self, ray: &IndexRay, range: (f64, f64)) -> f64 {
        match self.projector {
            Projector::Siddon => siddon::line_integral(self.field, ray, range),
            // Sums over slices have Joseph's samples.
            _ => joseph::interval_integral(self.field, ray, range),
        }
    }
}
