//! Labels of a frame: one walk through the voxels per pixel. The walks of the last frame are kept; in the
//! next frame of the same C-arm only the rays that meet a voxel removed since then are walked again.

use pulp::Arch;
use rayon::prelude::*;
use smallvec::SmallVec;

use super::standing::DirtyMarker;
use super::{DrrRenderer, Projector};
use crate::attenuation::Material;
use crate::carm::{CArm, PixelBox};
use crate::error::DrrError;
use crate::grid::{Grid, VolumeView};
use crate::label_walk::{Piece, SlabWalk, Visit};
use crate::labels::{Class, LabelRequest, Labels, keypoints, markers};
use crate::lanes::lanes;
use crate::ray::{IndexRay, RayFan, WorldRay};
use crate::removal::{AttenuationField, is_drilled, is_occupied};
use crate::siddon;
use crate::solids::Solids;
use crate::tool::{PreparedPart, SeenPart, join_intervals};

/// Rays that a thread walks at a time.
const WALKED_TOGETHER: usize = 64;

impl DrrRenderer {
    /// Labels a frame of the current voxels. Depends on the same inputs as a frame, except for the seed, and
    /// not on earlier frames; does not change what [`DrrRenderer::render`] caches.
    ///
    /// # Errors
    /// The view has another grid, or the C-arm or the tool is invalid.
    pub fn labels(
        &mut self,
        view: &VolumeView<'_>,
        c_arm: &CArm,
        request: &LabelRequest<'_>,
    ) -> Result<Labels, DrrError> {
        self.check_view(view)?;
        c_arm.validate()?;
        let prepared = request.tool.prepared().collect::<Result<Vec<PreparedPart>, DrrError>>()?;
        let fan = RayFan::new(&self.grid, c_arm);
        let kept = self.labelled.take();
        let kept = kept.filter(|kept| kept.c_arm == *c_arm && kept.bone_from_hu == request.bone_from_hu);
        let mut solids = Solids::default();
        let energy_kev = self.parameters.energy_kev;
        self.pool.install(|| solids.draw(request.tool, c_arm, &fan, energy_kev))?;
        let labeller = Labeller {
            renderer: self,
            tissue: self.tissue.field(view, &self.removed),
            bone: self.bone.as_ref().map(|layer| layer.field(view, &self.removed)),
            fan,
            solids,
            parts: self.parts_in_view(&prepared, c_arm, [request.burr, request.tool.parts.len()])?,
            bone_from_hu: request.bone_from_hu,
            bone_attenuates: self.bone_attenuates(request.bone_from_hu),
            source_detector_m: c_arm.sight().1,
        };
        let columns = c_arm.columns as usize;
        let mut pixels = vec![PixelLabel::default(); c_arm.pixels()];
        let voxels = self.pool.install(|| {
            let voxels = labeller.updated(kept, c_arm);
            let rows = pixels.par_chunks_mut(columns).zip(voxels.along.par_chunks(columns)).enumerate();
            rows.for_each(|(row, (pixels, voxels))| {
                Arch::new().dispatch(RowOfLabels { labeller: &labeller, row: row as u32, voxels, pixels });
            });
            voxels
        });
        self.labelled = Some(voxels);
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
            markers: markers(c_arm, request.tool, &prepared, request.markers),
        })
    }

    /// Returns true if every voxel that counts as bone attenuates, so that no bone is in an empty block.
    fn bone_attenuates(&self, bone_from_hu: i16) -> bool {
        let layers = || core::iter::once(&self.tissue).chain(&self.bone);
        (bone_from_hu..=i16::MAX).all(|hu| layers().any(|layer| layer.attenuates(hu)))
    }

    fn parts_in_view(
        &self,
        prepared: &[PreparedPart],
        c_arm: &CArm,
        [burr, objects]: [usize; 2],
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
                class: match number {
                    object if object >= objects => Class::Object,
                    of_burr if of_burr >= burr => Class::Burr,
                    _ => Class::Tool,
                },
            }));
        }
        Ok(parts)
    }
}

/// A part of the tool and its bounding box in the image.
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
#[derive(Debug, Clone, Default)]
pub(crate) struct PixelLabel {
    mask: u8,
    anatomy: f32,
    metal: f32,
    bone_m: f32,
    tunnel_m: f32,
    tool_depth_m: f32,
    bone_depth_m: f32,
}

/// The voxels on the rays of a C-arm.
pub(super) struct StandingLabels {
    c_arm: CArm,
    bone_from_hu: i16,
    along: Vec<AlongVoxels>,
    /// True for pixels in `dirty_list`.
    dirty: Vec<bool>,
    /// Pixels whose rays meet voxels removed since they were walked.
    dirty_list: Vec<u32>,
}

impl StandingLabels {
    /// Returns the marker of the pixels that a removed voxel affects.
    pub fn marker(&mut self, grid: &Grid) -> DirtyMarker<'_> {
        let Self { c_arm, dirty, dirty_list, .. } = self;
        DirtyMarker::of(dirty, dirty_list, c_arm, grid, Projector::Siddon)
    }
}

/// The voxels on a ray.
#[derive(Debug, Clone, Default)]
pub(crate) struct AlongVoxels {
    /// Integrals of the renderer's layers.
    tissue: f64,
    cortical: f64,
    bone_m: f64,
    tunnel_m: f64,
    /// Parameter of the ray.
    bone_at: Option<f64>,
}

/// Hounsfield values of the voxels of a slab; `None`, which would be a bug, if one is outside.
#[inline(always)]
fn hu_of(hu: &[i16], pieces: &[Piece; 3]) -> Option<[i16; 3]> {
    let of = |piece: &Piece| hu.get(piece.linear).copied();
    Some([of(&pieces[0])?, of(&pieces[1])?, of(&pieces[2])?])
}

/// Integral over a slab. The slab is summed separately first, so that no addition waits for the slab before
/// it.
#[inline(always)]
fn integral(field: &AttenuationField<'_>, pieces: &[Piece; 3], hu: [i16; 3], gone: [bool; 3]) -> f64 {
    let part = |i: usize| {
        let intact = field.table.mu_per_m(hu[i]);
        pieces[i].length * if gone[i] { field.fill_mu_per_m } else { intact }
    };
    part(0) + part(1) + part(2)
}

/// Total length of the pieces of a slab that count.
#[inline(always)]
fn total(pieces: &[Piece; 3], counts: [bool; 3]) -> f64 {
    let part = |i: usize| if counts[i] { pieces[i].length } else { 0.0 };
    part(0) + part(1) + part(2)
}

/// The tool, the arm and the objects on a ray.
#[derive(Default)]
struct AlongTool {
    mask: u8,
    /// Line integral at the frame's energy.
    metal: f64,
    lengths_m: [f64; Material::COUNT],
    /// Ray parameters inside parts of the tool and objects; intervals of overlapping parts can overlap.
    envelopes: SmallVec<[(f64, f64); 16]>,
    /// Parameter of the ray.
    metal_at: Option<f64>,
}

pub(crate) struct Labeller<'a> {
    renderer: &'a DrrRenderer,
    tissue: AttenuationField<'a>,
    bone: Option<AttenuationField<'a>>,
    fan: RayFan,
    solids: Solids,
    parts: Vec<PartInView>,
    bone_from_hu: i16,
    bone_attenuates: bool,
    source_detector_m: f64,
}

lanes! {
    /// Labels a row of pixels, given the voxels on its rays.
    RowOfLabels {
        labeller: &'a Labeller<'a>, row: u32, voxels: &'a [AlongVoxels], pixels: &'a mut [PixelLabel]
    } -> () {
        for ((column, pixel), voxels) in pixels.iter_mut().enumerate().zip(voxels) {
            *pixel = labeller.label(column as u32, row, voxels);
        }
    }
}

lanes! {
    /// Walks the rays of a row of pixels.
    RowOfVoxels { labeller: &'a Labeller<'a>, row: u32, voxels: &'a mut [AlongVoxels] } -> () {
        for (column, voxels) in voxels.iter_mut().enumerate() {
            *voxels = labeller.along_voxels(&labeller.fan.index_ray(column as u32, row));
        }
    }
}

lanes! {
    /// Walks the rays of some pixels.
    SomeVoxels {
        labeller: &'a Labeller<'a>, columns: u32, pixels: &'a [u32], voxels: &'a mut [AlongVoxels]
    } -> () {
        for (pixel, voxels) in pixels.iter().zip(voxels) {
            let ray = labeller.fan.index_ray(pixel % columns, pixel / columns);
            *voxels = labeller.along_voxels(&ray);
        }
    }
}

impl Labeller<'_> {
    /// Returns the voxels on all rays; those of an earlier frame of the C-arm are walked again where voxels
    /// were removed since.
    fn updated(&self, kept: Option<StandingLabels>, c_arm: &CArm) -> StandingLabels {
        let columns = c_arm.columns;
        let Some(mut kept) = kept else {
            let mut along = vec![AlongVoxels::default(); c_arm.pixels()];
            along.par_chunks_mut(columns as usize).enumerate().for_each(|(row, voxels)| {
                Arch::new().dispatch(RowOfVoxels { labeller: self, row: row as u32, voxels });
            });
            let (dirty, dirty_list) = (vec![false; c_arm.pixels()], Vec::new());
            return StandingLabels {
                c_arm: *c_arm,
                bone_from_hu: self.bone_from_hu,
                along,
                dirty,
                dirty_list,
            };
        };
        let list = core::mem::take(&mut kept.dirty_list);
        let mut again = vec![AlongVoxels::default(); list.len()];
        list.par_chunks(WALKED_TOGETHER).zip(again.par_chunks_mut(WALKED_TOGETHER)).for_each(
            |(pixels, voxels)| {
                Arch::new().dispatch(SomeVoxels { labeller: self, columns, pixels, voxels });
            },
        );
        for (&pixel, voxels) in list.iter().zip(again) {
            kept.dirty[pixel as usize] = false;
            kept.along[pixel as usize] = voxels;
        }
        kept
    }

    #[inline(always)]
    fn label(&self, column: u32, row: u32, voxels: &AlongVoxels) -> PixelLabel {
        let ray = self.fan.world_ray(column, row);
        let index_ray = self.fan.index_ray_of(column, row, &ray);
        let mut tool = self.along_tool(column, row, &ray);
        for solid in self.solids.rows(row as usize, column as usize, 1) {
            let length_m = solid.lengths_m[0];
            tool.metal += solid.mu_per_m * length_m;
            tool.lengths_m[solid.material] += length_m;
            if solid.is_object && length_m > 0.0 {
                tool.mask |= Class::Object.bit();
            }
        }
        let (anatomy, metal) = self.attenuations(&index_ray, voxels, &mut tool);
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

    #[inline(always)]
    fn along_voxels(&self, ray: &IndexRay) -> AlongVoxels {
        let mut along = AlongVoxels::default();
        let (grid, strides) = (self.tissue.view.grid(), self.tissue.blocks.strides());
        let Some(walk) = SlabWalk::new(grid, strides, ray) else { return along };
        let hu = self.tissue.view.hu();
        walk.walk(
            |block| self.visit(block),
            |drilled, pieces| {
                let Some(hu) = hu_of(hu, &pieces) else { return };
                let gone = pieces.map(|piece| drilled && self.tissue.removed.contains(piece.linear));
                along.tissue += integral(&self.tissue, &pieces, hu, gone);
                if let Some(bone) = &self.bone {
                    along.cortical += integral(bone, &pieces, hu, gone);
                }
                let is_bone = [0, 1, 2].map(|i| hu[i] >= self.bone_from_hu && !gone[i]);
                if is_bone != [false; 3] {
                    let in_bone = |i: &usize| is_bone[*i] && pieces[*i].length > 0.0;
                    along.bone_at = along.bone_at.or_else(|| (0..3).find(in_bone).map(|i| pieces[i].from));
                    along.bone_m += total(&pieces, is_bone);
                }
                if drilled {
                    along.tunnel_m += total(&pieces, gone);
                }
            },
        );
        for length in [&mut along.tissue, &mut along.cortical, &mut along.bone_m, &mut along.tunnel_m] {
            *length *= ray.length_m;
        }
        along
    }

    /// How to visit a block, from the flags of both layers.
    #[inline(always)]
    fn visit(&self, block: usize) -> Visit {
        // A missing block would be a bug; it must not hide anything.
        let flags =
            |field: &AttenuationField<'_>| field.blocks.flags().get(block).copied().unwrap_or(u8::MAX);
        let flags = flags(&self.tissue) | self.bone.as_ref().map_or(0, flags);
        match (is_drilled(flags), is_occupied(flags) || !self.bone_attenuates) {
            (true, _) => Visit::Drilled,
            (false, true) => Visit::Intact,
            (false, false) => Visit::Skip,
        }
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
                if placed.class == Class::Object {
                    continue;
                }
                let first = along.metal_at.map_or(crossing.envelope.0, |at| at.min(crossing.envelope.0));
                along.metal_at = Some(first);
            }
        }
        along
    }

    /// Attenuation of the anatomy around the tool and the metal's contribution, as the renderer computes them
    /// with Siddon's projector.
    fn attenuations(&self, ray: &IndexRay, voxels: &AlongVoxels, tool: &mut AlongTool) -> (f64, f64) {
        let (mut tissue, mut cortical) = (voxels.tissue, voxels.cortical);
        if !tool.envelopes.is_empty() {
            let joined = join_intervals(&mut tool.envelopes);
            let displaced = |field: &AttenuationField<'_>| -> f64 {
                tool.envelopes[..joined].iter().map(|&range| siddon::line_integral(field, ray, range)).sum()
            };
            // Fully displaced anatomy can leave a slightly negative rest from rounding.
            tissue = (tissue - displaced(&self.tissue)).max(0.0);
            cortical = self.bone.as_ref().map_or(0.0, |bone| (cortical - displaced(bone)).max(0.0));
        }
        match self.renderer.exposure.spectrum() {
            None => (tissue, tool.metal),
            Some(table) if tool.lengths_m == [0.0; Material::COUNT] && tool.envelopes.is_empty() => {
                (table.attenuation(tissue, cortical), 0.0)
            }
            Some(table) => {
                let anatomy = table.exact(tissue, cortical, &[0.0; Material::COUNT]);
                (anatomy, table.exact(tissue, cortical, &tool.lengths_m) - anatomy)
            }
        }
    }
}
