//! The renderer: the cached anatomy of a standing C-arm, the tool of the frame, and their exposure.

use rayon::prelude::*;

use crate::attenuation::{ENERGY_RANGE_KEV, HuLaw, Material, MuTable};
use crate::carm::{CArm, Pinhole};
use crate::detector::{DetectorParameters, FrameSeed};
use crate::display::{DisplayParameters, window_limits};
use crate::error::{DrrError, check_range};
use crate::exposure::{Anatomy, Exposure, Output};
use crate::grid::{Grid, VolumeView};
use crate::ray::{IndexRay, RayFan};
use crate::removal::{AttenuationField, BlockMap, RemovedVoxels};
use crate::slice_ordered::{SliceOrdered, SliceOrderedMemory, SliceOrderedOptions, Update};
use crate::spectrum::{Spectrum, SpectrumTable};
use crate::tool::Tool;
use crate::tool_layer::{DisplacedBy, PlacedTool};
use crate::vector::scale;
use crate::{joseph, siddon};

/// Fewer rays than this are traced without waking the worker threads.
const PARALLEL_FROM: usize = 256;
/// How far from a voxel's centre a ray can still feel it, in voxels, and a margin for rounding.
const REACH_JOSEPH: f64 = 1.0 + 1e-3;
const REACH_SIDDON: f64 = 0.5 + 1e-3;

/// How the anatomy's line integrals are computed, from the exact to the quick.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Projector {
    /// Exact for voxels of constant attenuation ([`siddon`]): the reference, a thousand times slower than the default.
    Siddon,
    /// Bilinear interpolation plane by plane, ray by ray ([`joseph`]).
    Joseph,
    /// All slices summed in the volume's own order, then warped ([`slice_ordered`](crate::slice_ordered)): as exact as Joseph beside the
    /// error of the voxels themselves. Keeps a copy of the volume for each of two orders, made when a frame needs it.
    SliceOrdered {
        /// Samples for each voxel of the farthest slice, 0.8 to 4: more are slower, and closer to Joseph.
        oversampling: f64,
        /// Whether the blur of the interpolation is taken back.
        sharpen: bool,
    },
    /// As `SliceOrdered` on a volume of block means in bytes.
    Preview {
        /// Voxels along each axis that are joined to one, 2 to 8.
        reduction: u32,
    },
}

impl Projector {
    /// One sample a voxel, sharpened.
    pub const SLICE_ORDERED: Self = Self::SliceOrdered { oversampling: 1.0, sharpen: true };
    /// Two voxels to one along each axis.
    pub const PREVIEW: Self = Self::Preview { reduction: 2 };

    /// Options of the sum over slices; `None` where rays are traced one by one.
    ///
    /// # Errors
    /// An oversampling or a reduction out of range.
    fn slice_ordered(self) -> Result<Option<SliceOrderedOptions>, DrrError> {
        let options = match self {
            Self::Siddon | Self::Joseph => return Ok(None),
            Self::SliceOrdered { oversampling, sharpen } => {
                SliceOrderedOptions { oversampling, sharpen, ..SliceOrderedOptions::default() }
            }
            Self::Preview { reduction } => {
                check_range("reduction", f64::from(reduction), 2.0, 8.0, "2 to 8")?;
                SliceOrderedOptions { reduction, ..SliceOrderedOptions::default() }
            }
        };
        options.validate()?;
        Ok(Some(options))
    }
}

impl Default for Projector {
    fn default() -> Self {
        Self::SLICE_ORDERED
    }
}

/// Everything about the frames that is not the scene.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct DrrParameters {
    /// How line integrals are computed.
    pub projector: Projector,
    /// Photon energy, 30 to 120 keV. 60 is about the mean of a 90 kV beam.
    pub energy_kev: f64,
    /// Hounsfield units to attenuation.
    pub hu_law: HuLaw,
    /// Many energies instead of one; `energy_kev` and `hu_law` then have no effect.
    pub spectrum: Option<Spectrum>,
    /// Below this the CT is air and attenuates nothing.
    pub air_below_hu: i16,
    /// What fills a removed voxel: air by default, about 0 for irrigation.
    pub fill_hu: i16,
    /// Worker threads, 1 to 64. The frame does not depend on it.
    pub threads: usize,
    /// The detector.
    pub detector: DetectorParameters,
    /// The display.
    pub display: DisplayParameters,
}

impl Default for DrrParameters {
    fn default() -> Self {
        Self {
            projector: Projector::default(),
            energy_kev: 60.0,
            hu_law: HuLaw::WaterScaling,
            spectrum: None,
            air_below_hu: -900,
            fill_hu: -1000,
            threads: 2,
            detector: DetectorParameters::default(),
            display: DisplayParameters::default(),
        }
    }
}

/// How much of the anatomy was traced for a frame.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum RenderKind {
    /// All of it: a new C-arm, or so many removed voxels that this is quicker.
    Full,
    /// What newly removed voxels change.
    Incremental,
    /// Nothing had changed.
    Cached,
}

/// What a frame took.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct FrameReport {
    /// How much of the anatomy was traced.
    pub kind: RenderKind,
    /// Pixels whose anatomy was computed.
    pub rays_traced: usize,
    /// Pixels that the tool covers.
    pub tool_pixels: usize,
    /// Attenuations at the two ends of the display's scale.
    pub window: (f64, f64),
}

/// The cached anatomy of one C-arm.
struct Standing {
    c_arm: CArm,
    fan: RayFan,
    /// Whether rays are traced one by one, so that `dirty` counts.
    traced: bool,
    /// Line integrals of the anatomy (with a spectrum, metres of tissue), row by row.
    anatomy: Vec<f64>,
    /// Metres of cortical bone, with a spectrum.
    bone_m: Vec<f64>,
    /// Whether a pixel is in `dirty_list`.
    dirty: Vec<bool>,
    dirty_list: Vec<u32>,
    window: (f64, f64),
}

/// What rays are integrated over.
struct Layer {
    table: MuTable,
    fill_per_m: f64,
    blocks: BlockMap,
    intact_blocks: BlockMap,
    /// The sums over slices, where the projector is of that kind.
    slices: Option<SliceOrdered>,
}

impl Layer {
    fn new(
        view: &VolumeView<'_>,
        table: MuTable,
        unit_per_m: f64,
        parameters: &DrrParameters,
    ) -> Result<Self, DrrError> {
        let blocks = BlockMap::new(view, &table);
        let fill_per_m = table.mu_per_m(parameters.fill_hu);
        let slices = match parameters.projector.slice_ordered()? {
            Some(options) => Some(SliceOrdered::new(view, &table, unit_per_m, fill_per_m, options)?),
            None => None,
        };
        Ok(Self { fill_per_m, table, intact_blocks: blocks.clone(), blocks, slices })
    }

    fn field<'a>(&'a self, view: &VolumeView<'a>, removed: &'a RemovedVoxels) -> AttenuationField<'a> {
        AttenuationField {
            view: *view,
            removed,
            blocks: &self.blocks,
            table: &self.table,
            fill_mu_per_m: self.fill_per_m,
        }
    }

    /// Notes a removed voxel; whether that changes anything.
    fn remove(
        &mut self,
        view: &VolumeView<'_>,
        linear: usize,
        voxel: [usize; 3],
        hu: i16,
    ) -> Result<bool, DrrError> {
        self.blocks.mark_drilled(voxel, self.fill_per_m > 0.0);
        if let Some(slices) = &mut self.slices {
            slices.remove(view, linear)?;
        }
        Ok(self.table.mu_per_m(hu) != self.fill_per_m)
    }

    /// Puts all voxels back.
    fn restore(&mut self, view: &VolumeView<'_>) {
        self.blocks.clone_from(&self.intact_blocks);
        if let Some(slices) = &mut self.slices {
            slices.restore_all(view);
        }
    }

    /// Brings `image` up to date by sums over slices; `None`, and nothing written, where rays have to be traced.
    fn project(
        &mut self,
        view: &VolumeView<'_>,
        removed: &RemovedVoxels,
        c_arm: &CArm,
        image: &mut Vec<f64>,
        pool: &rayon::ThreadPool,
    ) -> Result<Option<(RenderKind, usize)>, DrrError> {
        let Some(slices) = &mut self.slices else { return Ok(None) };
        let fresh = image.is_empty();
        image.resize(c_arm.pixels(), 0.0);
        if fresh {
            slices.forget();
        }
        let update = match slices.refresh(c_arm, image) {
            None => pool.install(|| slices.project(view, removed, c_arm, image))?,
            some => some,
        };
        if update.is_none() && fresh {
            image.clear();
        }
        Ok(update.map(|update| match update {
            Update::Full => (RenderKind::Full, c_arm.pixels()),
            Update::Changed(pixels) => (RenderKind::Incremental, pixels),
            Update::Unchanged => (RenderKind::Cached, 0),
        }))
    }
}

/// Of what two layers took, the larger.
fn more_of(a: (RenderKind, usize), b: (RenderKind, usize)) -> (RenderKind, usize) {
    if b.1 > a.1 { b } else { a }
}

/// Renders frames of one CT. Holds small data derived from it, the removed voxels, and the cache of the C-arm.
pub struct DrrRenderer {
    parameters: DrrParameters,
    grid: Grid,
    /// Attenuation at the frame's energy; with a spectrum, metres of tissue.
    tissue: Layer,
    /// With a spectrum, metres of cortical bone.
    bone: Option<Layer>,
    removed: RemovedVoxels,
    exposure: Exposure,
    tool: PlacedTool,
    pool: rayon::ThreadPool,
    standing: Option<Standing>,
}

impl DrrRenderer {
    /// Reads the CT once to find its empty blocks; keeps no copy of it.
    ///
    /// # Errors
    /// A parameter out of range, by name; worker threads that cannot be started.
    pub fn new(view: &VolumeView<'_>, parameters: DrrParameters) -> Result<Self, DrrError> {
        let (low, high) = ENERGY_RANGE_KEV;
        check_range("energy_kev", parameters.energy_kev, low, high, "30 to 120 keV")?;
        check_range("threads", parameters.threads as f64, 1.0, 64.0, "1 to 64")?;
        parameters.detector.validate()?;
        parameters.display.validate()?;
        let threads = parameters.threads;
        let pool = rayon::ThreadPoolBuilder::new()
            .num_threads(threads)
            .thread_name(|i| format!("drr-{i}"))
            .build()
            .map_err(|e| DrrError::Threads { threads, reason: e.to_string() })?;
        let (law, air) = (parameters.hu_law, parameters.air_below_hu);
        let (tissue, bone, spectrum) = match &parameters.spectrum {
            None => (MuTable::new(law, parameters.energy_kev, air)?, None, None),
            Some(spectrum) => {
                let table = SpectrumTable::new(spectrum)?;
                let mixture = table.mixture();
                let tissue = MuTable::of(air, |hu| mixture.of(hu).0);
                (tissue, Some(MuTable::of(air, |hu| mixture.of(hu).1)), Some(table))
            }
        };
        // One Hounsfield unit of water scaling: that law is stored without rounding. A spectrum's shares lie near 1.
        let unit_per_m = match spectrum {
            None => Material::Water.mu_per_m(parameters.energy_kev)? / 1000.0,
            Some(_) => 1e-3,
        };
        let layer = |table| Layer::new(view, table, unit_per_m, &parameters);
        Ok(Self {
            grid: *view.grid(),
            tissue: layer(tissue)?,
            bone: bone.map(layer).transpose()?,
            parameters,
            removed: RemovedVoxels::new(view.grid()),
            exposure: Exposure::new(parameters.detector, parameters.display, spectrum),
            tool: PlacedTool::default(),
            pool,
            standing: None,
        })
    }

    /// Makes what frames of this C-arm need once (a re-ordered copy of the volume), so that the first does not wait for it.
    ///
    /// # Errors
    /// A view of another grid, a bad C-arm, a volume whose copy does not fit into the free memory.
    pub fn prepare(&mut self, view: &VolumeView<'_>, c_arm: &CArm) -> Result<(), DrrError> {
        self.check_view(view)?;
        c_arm.validate()?;
        let Self { tissue, bone, removed, pool, .. } = self;
        for slices in core::iter::once(tissue).chain(bone).filter_map(|layer| layer.slices.as_mut()) {
            pool.install(|| slices.prepare(view, removed, c_arm))?;
        }
        Ok(())
    }

    /// Bytes of the re-ordered copies and the intermediate image; all 0 where rays are traced one by one. With a spectrum, bone has as
    /// much again.
    pub fn slice_ordered_memory(&self) -> SliceOrderedMemory {
        self.tissue.slices.as_ref().map(SliceOrdered::memory).unwrap_or_default()
    }

    /// The parameters.
    pub fn parameters(&self) -> &DrrParameters {
        &self.parameters
    }

    /// The voxels removed so far.
    pub fn removed(&self) -> &RemovedVoxels {
        &self.removed
    }

    /// Line integrals of the anatomy behind the last frame, row by row; empty before the first.
    pub fn anatomy(&self) -> &[f64] {
        self.standing.as_ref().map_or(&[], |s| &s.anatomy)
    }

    /// Attenuation (-ln of the share that passes) of anatomy and tool behind the last frame, row by row; empty before the first.
    pub fn line_integrals(&self) -> Vec<f64> {
        let attenuation =
            |s: &Standing| self.exposure.attenuations(s.images(), &self.tool, s.c_arm.columns as usize);
        self.standing.as_ref().map_or(Vec::new(), attenuation)
    }

    /// Removes voxels by linear index; those already removed are ignored. Returns how many are new. The order and the grouping into
    /// batches do not matter.
    ///
    /// # Errors
    /// A view of another grid, or an index outside the volume: then the whole batch is refused.
    pub fn remove(&mut self, view: &VolumeView<'_>, batch: &[u32]) -> Result<usize, DrrError> {
        self.check_view(view)?;
        self.removed.check(batch)?;
        let traced = self.standing.as_mut().filter(|s| s.traced);
        let mut marker = traced.map(|s| DirtyMarker::new(s, &self.grid, self.parameters.projector));
        let mut new = 0;
        for &index in batch {
            let linear = index as usize;
            if !self.removed.insert(linear) {
                continue;
            }
            new += 1;
            let voxel = self.grid.voxel_of(linear);
            let hu = view.hu().get(linear).copied().unwrap_or(self.parameters.fill_hu);
            let mut changed = self.tissue.remove(view, linear, voxel, hu)?;
            if let Some(bone) = &mut self.bone {
                changed |= bone.remove(view, linear, voxel, hu)?;
            }
            if let Some(marker) = marker.as_mut().filter(|_| changed) {
                marker.mark(self.grid.index_to_world(voxel.map(|v| v as f64)));
            }
        }
        Ok(new)
    }

    /// Puts all removed voxels back; the next frame is rendered in full.
    ///
    /// # Errors
    /// A view of another grid.
    pub fn restore_all(&mut self, view: &VolumeView<'_>) -> Result<(), DrrError> {
        self.check_view(view)?;
        self.removed.clear();
        for layer in core::iter::once(&mut self.tissue).chain(&mut self.bone) {
            layer.restore(view);
        }
        self.standing = None;
        Ok(())
    }

    /// Renders a frame into `image` (rows from top to bottom, one u16 a pixel).
    ///
    /// # Errors
    /// A view of another grid, a bad C-arm or tool, an image of another size. The cache survives.
    pub fn render(
        &mut self,
        view: &VolumeView<'_>,
        c_arm: &CArm,
        tool: &Tool,
        seed: FrameSeed,
        image: &mut [u16],
    ) -> Result<FrameReport, DrrError> {
        self.render_to(view, c_arm, tool, seed, Output::Mono16(image))
    }

    /// As [`DrrRenderer::render`], for any kind of pixel.
    ///
    /// # Errors
    /// The same.
    pub fn render_to(
        &mut self,
        view: &VolumeView<'_>,
        c_arm: &CArm,
        tool: &Tool,
        seed: FrameSeed,
        mut output: Output<'_>,
    ) -> Result<FrameReport, DrrError> {
        self.check_view(view)?;
        c_arm.validate()?;
        if output.len() != c_arm.pixels() {
            return Err(DrrError::Length { field: "image", given: output.len(), expected: c_arm.pixels() });
        }
        self.tool.place(tool, c_arm, self.parameters.energy_kev)?;
        let mut standing = match self.standing.take() {
            Some(s) if s.c_arm == *c_arm => s,
            _ => Standing::new(&self.grid, c_arm),
        };
        let (kind, rays_traced) = self.update_anatomy(view, &mut standing)?;
        if kind != RenderKind::Cached {
            let window = self.parameters.display.window;
            standing.window = self.exposure.with_anatomy(standing.images(), |a| window_limits(window, a));
        }
        let width = standing.c_arm.columns as usize;
        let tissue = self.tissue.field(view, &self.removed);
        let bone = self.bone.as_ref().map(|layer| layer.field(view, &self.removed));
        let anatomy =
            DisplacedBy { projector: self.parameters.projector, tissue: &tissue, bone: bone.as_ref() };
        let (tool, exposure) = (&mut self.tool, &mut self.exposure);
        let tool_pixels = self.pool.install(|| {
            let covered = tool.draw(&standing.fan, &anatomy);
            exposure.expose(standing.images(), tool, width, standing.window, seed, &mut output);
            covered
        });
        let window = standing.window;
        self.standing = Some(standing);
        Ok(FrameReport { kind, rays_traced, tool_pixels, window })
    }

    /// As [`DrrRenderer::render`] for a C-arm that does not stay: what is cached of the standing one survives, so its next frame costs
    /// what it would have cost without this one.
    ///
    /// # Errors
    /// The same.
    pub fn render_aside(
        &mut self,
        view: &VolumeView<'_>,
        c_arm: &CArm,
        tool: &Tool,
        seed: FrameSeed,
        image: &mut [u16],
    ) -> Result<FrameReport, DrrError> {
        if self.standing.as_ref().is_some_and(|standing| standing.c_arm == *c_arm) {
            return self.render(view, c_arm, tool, seed, image);
        }
        let standing = self.standing.take();
        self.layers_slices().for_each(SliceOrdered::step_aside);
        let report = self.render(view, c_arm, tool, seed, image);
        self.layers_slices().for_each(SliceOrdered::step_back);
        self.standing = standing;
        report
    }

    fn layers_slices(&mut self) -> impl Iterator<Item = &mut SliceOrdered> {
        core::iter::once(&mut self.tissue).chain(&mut self.bone).filter_map(|layer| layer.slices.as_mut())
    }

    fn check_view(&self, view: &VolumeView<'_>) -> Result<(), DrrError> {
        if *view.grid() == self.grid { Ok(()) } else { Err(DrrError::GridChanged) }
    }

    fn trace(&self, field: &AttenuationField<'_>, ray: &IndexRay) -> f64 {
        match self.parameters.projector {
            Projector::Siddon => siddon::line_integral(field, ray, (0.0, 1.0)),
            _ => joseph::line_integral(field, ray),
        }
    }

    /// Brings the anatomy's line integrals up to date.
    fn update_anatomy(
        &mut self,
        view: &VolumeView<'_>,
        standing: &mut Standing,
    ) -> Result<(RenderKind, usize), DrrError> {
        let fresh = standing.anatomy.is_empty();
        if fresh || !standing.traced {
            let Self { tissue, bone, removed, pool, .. } = self;
            let c_arm = &standing.c_arm;
            let first = tissue.project(view, removed, c_arm, &mut standing.anatomy, pool)?;
            if let Some(mut done) = first {
                if let Some(bone) = bone {
                    let second = bone.project(view, removed, c_arm, &mut standing.bone_m, pool)?;
                    done = second.map_or(done, |second| more_of(done, second));
                }
                standing.traced = false;
                return Ok(done);
            }
        }
        Ok(self.trace_anatomy(view, standing))
    }

    /// The same ray by ray.
    fn trace_anatomy(&self, view: &VolumeView<'_>, standing: &mut Standing) -> (RenderKind, usize) {
        let tissue = self.tissue.field(view, &self.removed);
        let bone = self.bone.as_ref().map(|layer| layer.field(view, &self.removed));
        if standing.anatomy.is_empty() {
            self.trace_all(&tissue, standing.c_arm, &standing.fan, &mut standing.anatomy);
            if let Some(bone) = &bone {
                self.trace_all(bone, standing.c_arm, &standing.fan, &mut standing.bone_m);
            }
            return (RenderKind::Full, standing.anatomy.len());
        }
        if standing.dirty_list.is_empty() {
            return (RenderKind::Cached, 0);
        }
        let mut list = core::mem::take(&mut standing.dirty_list);
        // Neighbouring rays one after the other share cache lines; the result does not depend on the order.
        list.sort_unstable();
        let (columns, fan) = (standing.c_arm.columns, standing.fan);
        self.trace_list(&tissue, columns, &fan, &list, &mut standing.anatomy);
        if let Some(bone) = &bone {
            self.trace_list(bone, columns, &fan, &list, &mut standing.bone_m);
        }
        for &pixel in &list {
            standing.dirty[pixel as usize] = false;
        }
        let traced = list.len();
        list.clear();
        standing.dirty_list = list;
        (RenderKind::Incremental, traced)
    }

    fn trace_all(&self, field: &AttenuationField<'_>, c_arm: CArm, fan: &RayFan, image: &mut Vec<f64>) {
        image.resize(c_arm.pixels(), 0.0);
        let rows = image.par_chunks_mut(c_arm.columns as usize).zip(0_u32..c_arm.rows);
        self.pool.install(|| {
            rows.for_each(|(line, row)| {
                for (value, column) in line.iter_mut().zip(0_u32..) {
                    *value = self.trace(field, &fan.index_ray(column, row));
                }
            });
        });
    }

    fn trace_list(
        &self,
        field: &AttenuationField<'_>,
        columns: u32,
        fan: &RayFan,
        list: &[u32],
        image: &mut [f64],
    ) {
        let one = |&pixel: &u32| self.trace(field, &fan.index_ray(pixel % columns, pixel / columns));
        let values: Vec<f64> = if list.len() < PARALLEL_FROM {
            list.iter().map(one).collect()
        } else {
            self.pool.install(|| list.par_iter().with_min_len(64).map(one).collect())
        };
        for (&pixel, value) in list.iter().zip(values) {
            image[pixel as usize] = value;
        }
    }
}

impl Standing {
    fn images(&self) -> Anatomy<'_> {
        Anatomy { total: &self.anatomy, bone_m: &self.bone_m }
    }

    fn new(grid: &Grid, c_arm: &CArm) -> Self {
        let pixels = c_arm.pixels();
        Self {
            c_arm: *c_arm,
            fan: RayFan::new(grid, c_arm),
            traced: true,
            anatomy: Vec::new(),
            bone_m: Vec::new(),
            dirty: vec![false; pixels],
            dirty_list: Vec::new(),
            window: (0.0, 1.0),
        }
    }
}

/// Marks the pixels that removed voxels can reach.
struct DirtyMarker<'a> {
    dirty: &'a mut [bool],
    list: &'a mut Vec<u32>,
    pinhole: Pinhole,
    columns: u32,
    rows: u32,
    half_m: [[f64; 3]; 3],
}

impl<'a> DirtyMarker<'a> {
    fn new(standing: &'a mut Standing, grid: &Grid, projector: Projector) -> Self {
        let reach = match projector {
            Projector::Siddon => REACH_SIDDON,
            _ => REACH_JOSEPH,
        };
        Self {
            dirty: &mut standing.dirty,
            list: &mut standing.dirty_list,
            pinhole: standing.c_arm.pinhole(),
            columns: standing.c_arm.columns,
            rows: standing.c_arm.rows,
            half_m: grid.axis_steps_m().map(|s| scale(s, reach)),
        }
    }

    fn mark(&mut self, centre_m: [f64; 3]) {
        let Some(bounds) = self.pinhole.bounds(centre_m, &self.half_m, self.columns, self.rows) else {
            return;
        };
        for row in bounds.rows.0..bounds.rows.1 {
            for pixel in row * self.columns + bounds.columns.0..row * self.columns + bounds.columns.1 {
                let flag = &mut self.dirty[pixel as usize];
                if !*flag {
                    *flag = true;
                    self.list.push(pixel);
                }
            }
        }
    }
}
