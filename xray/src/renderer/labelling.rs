//! Labels of a frame: one walk through the voxels a pixel.

use rayon::prelude::*;
use smallvec::SmallVec;

use super::DrrRenderer;
use crate::attenuation::Material;
use crate::carm::{CArm, PixelBox};
use crate::error::DrrError;
use crate::grid::VolumeView;
use crate::labels::{Class, LabelRequest, Labels, keypoints};
use crate::ray::{RayFan, WorldRay};
use crate::removal::AttenuationField;
use crate::siddon;
use crate::tool::{PreparedPart, SeenPart, join_intervals};

impl DrrRenderer {
    /// The labels of a frame of the present voxels. A function of the same inputs as a frame, apart from its seed; reads and changes no
    /// cache.
    ///
    /// # Errors
    /// The view has another grid; the C-arm or the tool is invalid.
    pub fn labels(
        &self,
        view: &VolumeView<'_>,
        c_arm: &CArm,
        request: &LabelRequest<'_>,
    ) -> Result<Labels, DrrError> {
        self.check_view(view)?;
        c_arm.validate()?;
        let mut prepared = Vec::with_capacity(request.tool.parts.len());
        for (number, part) in request.tool.parts.iter().enumerate() {
            let refused = |reason| DrrError::ToolPart { part: number, reason };
            prepared.push(PreparedPart::new(part).map_err(refused)?);
        }
        let labeller = Labeller {
            renderer: self,
            tissue: self.tissue.field(view, &self.removed),
            bone: self.bone.as_ref().map(|layer| layer.field(view, &self.removed)),
            fan: RayFan::new(&self.grid, c_arm),
            parts: self.parts_in_view(&prepared, c_arm, request.burr)?,
            bone_from_hu: request.bone_from_hu,
            source_detector_m: c_arm.sight().1,
        };
        let columns = c_arm.columns as usize;
        let pixels: Vec<PixelLabel> = self.pool.install(|| {
            let pixels = (0..c_arm.pixels()).into_par_iter().with_min_len(columns);
            pixels.map(|i| labeller.label((i % columns) as u32, (i / columns) as u32)).collect()
        });
        let image = |of: fn(&PixelLabel) -> f32| pixels.iter().map(of).collect();
        Ok(Labels {
            columns: c_arm.columns,
            rows: c_arm.rows,
            mask: pixels.iter().map(|pixel| pixel.mask).collect(),
            anatomy: image(|pixel| pixel.anatomy),
            metal: image(|pixel| pixel.metal),
            bone_m: image(|pixel| pixel.bone_m),
            tunnel_m: image(|pixel| pixel.tunnel_m),
            tool_depth_m: image(|pixel| pixel.tool_depth_m),
            bone_depth_m: image(|pixel| pixel.bone_depth_m),
            keypoints: keypoints(c_arm, request.tool, &prepared, request.points_m),
        })
    }

    fn parts_in_view(
        &self,
        prepared: &[PreparedPart],
        c_arm: &CArm,
        burr: usize,
    ) -> Result<Vec<PartInView>, DrrError> {
        let mut parts = Vec::with_capacity(prepared.len());
        for (number, part) in prepared.iter().enumerate() {
            let mu_per_m = part.material().mu_per_m(self.parameters.energy_kev)?;
            let (centre_m, half_m) = part.box_from(c_arm.source_m);
            let pixels = c_arm.pinhole().bounds(centre_m, &half_m, c_arm.columns, c_arm.rows);
            parts.extend(pixels.map(|pixels| PartInView {
                part: part.seen_from(c_arm.source_m),
                pixels,
                mu_per_m,
                material: part.material().index(),
                class: if number >= burr { Class::Burr } else { Class::Tool },
            }));
        }
        Ok(parts)
    }
}

/// A part of the tool, and where in the image it may be.
struct PartInView {
    part: SeenPart,
    pixels: PixelBox,
    mu_per_m: f64,
    material: usize,
    class: Class,
}

impl PartInView {
    fn may_cover(&self, column: u32, row: u32) -> bool {
        let within = |x: u32, (first, end): (u32, u32)| x >= first && x < end;
        within(column, self.pixels.columns) && within(row, self.pixels.rows)
    }
}

/// The labels of a pixel, as in [`Labels`].
struct PixelLabel {
    mask: u8,
    anatomy: f32,
    metal: f32,
    bone_m: f32,
    tunnel_m: f32,
    tool_depth_m: f32,
    bone_depth_m: f32,
}

/// The voxels on a ray.
#[derive(Default)]
struct AlongVoxels {
    /// Integrals of the renderer's layers.
    tissue: f64,
    cortical: f64,
    bone_m: f64,
    tunnel_m: f64,
    /// Parameter of the ray.
    bone_at: Option<f64>,
}

/// The tool on a ray.
#[derive(Default)]
struct AlongTool {
    mask: u8,
    /// Line integral at the frame's energy.
    metal: f64,
    lengths_m: [f64; Material::COUNT],
    /// Parameters of the ray in parts of the tool; with those of one part more than once if they overlap.
    envelopes: SmallVec<[(f64, f64); 16]>,
    /// Parameter of the ray.
    metal_at: Option<f64>,
}

struct Labeller<'a> {
    renderer: &'a DrrRenderer,
    tissue: AttenuationField<'a>,
    bone: Option<AttenuationField<'a>>,
    fan: RayFan,
    parts: Vec<PartInView>,
    bone_from_hu: i16,
    source_detector_m: f64,
}

impl Labeller<'_> {
    fn label(&self, column: u32, row: u32) -> PixelLabel {
        let ray = self.fan.world_ray(column, row);
        let voxels = self.along_voxels(column, row);
        let mut tool = self.along_tool(column, row, &ray);
        let (anatomy, metal) = self.attenuations(column, row, &voxels, &mut tool);
        let bit = |there: bool, class: Class| if there { class.bit() } else { 0 };
        let depth_m = |at: Option<f64>| at.map_or(f32::NAN, |at| (at * self.source_detector_m) as f32);
        PixelLabel {
            mask: tool.mask
                | bit(voxels.bone_m > 0.0, Class::Bone)
                | bit(voxels.tunnel_m > 0.0, Class::Tunnel),
            anatomy: anatomy as f32,
            metal: metal as f32,
            bone_m: voxels.bone_m as f32,
            tunnel_m: voxels.tunnel_m as f32,
            tool_depth_m: depth_m(tool.metal_at),
            bone_depth_m: depth_m(voxels.bone_at),
        }
    }

    fn along_voxels(&self, column: u32, row: u32) -> AlongVoxels {
        let mut along = AlongVoxels::default();
        let (grid, ray) = (self.tissue.view.grid(), self.fan.index_ray(column, row));
        siddon::walk(grid, &ray, (0.0, 1.0), |linear, from, to| {
            along.tissue += self.tissue.mu_per_m(linear) * (to - from);
            if let Some(bone) = &self.bone {
                along.cortical += bone.mu_per_m(linear) * (to - from);
            }
            if self.tissue.removed.contains(linear) {
                along.tunnel_m += to - from;
            } else if self.tissue.view.hu().get(linear).is_some_and(|hu| *hu >= self.bone_from_hu) {
                along.bone_m += to - from;
                along.bone_at.get_or_insert(from);
            }
        });
        for length in [&mut along.tissue, &mut along.cortical, &mut along.bone_m, &mut along.tunnel_m] {
            *length *= ray.length_m;
        }
        along
    }

    fn along_tool(&self, column: u32, row: u32, ray: &WorldRay) -> AlongTool {
        let mut along = AlongTool::default();
        for placed in self.parts.iter().filter(|placed| placed.may_cover(column, row)) {
            let Some(crossing) = placed.part.cross(ray.direction_m, ray.length_m) else { continue };
            along.envelopes.push(crossing.envelope);
            along.metal += placed.mu_per_m * crossing.metal_m;
            along.lengths_m[placed.material] += crossing.metal_m;
            if crossing.metal_m > 0.0 {
                along.mask |= placed.class.bit();
                let first = along.metal_at.map_or(crossing.envelope.0, |at| at.min(crossing.envelope.0));
                along.metal_at = Some(first);
            }
        }
        along
    }

    /// Attenuation of the anatomy around the tool, and what the metal adds: as the renderer computes them with Siddon's projector.
    fn attenuations(&self, column: u32, row: u32, voxels: &AlongVoxels, tool: &mut AlongTool) -> (f64, f64) {
        let (mut tissue, mut cortical) = (voxels.tissue, voxels.cortical);
        if !tool.envelopes.is_empty() {
            let joined = join_intervals(&mut tool.envelopes);
            let ray = self.fan.index_ray(column, row);
            let displaced = |field: &AttenuationField<'_>| -> f64 {
                tool.envelopes[..joined].iter().map(|&range| siddon::line_integral(field, &ray, range)).sum()
            };
            // What is left of fully displaced anatomy may be slightly negative from rounding.
            tissue = (tissue - displaced(&self.tissue)).max(0.0);
            cortical = self.bone.as_ref().map_or(0.0, |bone| (cortical - displaced(bone)).max(0.0));
        }
        match self.renderer.exposure.spectrum() {
            None => (tissue, tool.metal),
            Some(table) if tool.envelopes.is_empty() => (table.attenuation(tissue, cortical), 0.0),
            Some(table) => {
                let anatomy = table.exact(tissue, cortical, &[0.0; Material::COUNT]);
                (anatomy, table.exact(tissue, cortical, &tool.lengths_m) - anatomy)
            }
        }
    }
}
