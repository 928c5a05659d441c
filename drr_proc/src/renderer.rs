//! The renderer: the cached anatomy of a standing C-arm, the tool of the frame, the detector and the display.

use rayon::prelude::*;

use crate::attenuation::{ENERGY_RANGE_KEV, HuLaw, Material, MuTable};
use crate::carm::{CArm, Pinhole};
use crate::detector::{DetectorParameters, FrameSeed, blur_column_into_row, blur_row, gaussian_weights};
use crate::display::{DisplayMode, DisplayParameters, display_value, window_limits};
use crate::error::{DrrError, check_range};
use crate::grid::{Grid, VolumeView};
use crate::ray::{IndexRay, RayFan};
use crate::removal::{AttenuationField, BlockMap, RemovedVoxels};
use crate::slice_ordered::{SliceOrdered, SliceOrderedMemory, SliceOrderedOptions, Update};
use crate::tool::Tool;
use crate::tool_layer::{PlacedPart, ToolLayer, place, row_span};
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
        /// Samples for each voxel of the farthest slice, 1 to 4: more are slower, and closer to Joseph.
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
    /// Line integrals of the anatomy, row by row.
    anatomy: Vec<f64>,
    /// Whether a pixel is in `dirty_list`.
    dirty: Vec<bool>,
    dirty_list: Vec<u32>,
    window: (f64, f64),
    /// Line integrals of anatomy and tool, of the metal alone, and two images of work space.
    total: Vec<f64>,
    metal: Vec<f64>,
    detected: Vec<f64>,
    work: Vec<f64>,
    blurred_metal: Vec<f64>,
}

/// Renders frames of one CT. Holds small data derived from it, the removed voxels, and the cache of the C-arm.
pub struct DrrRenderer {
    parameters: DrrParameters,
    grid: Grid,
    table: MuTable,
    fill_mu_per_m: f64,
    blocks: BlockMap,
    intact_blocks: BlockMap,
    removed: RemovedVoxels,
    blur: Vec<f64>,
    pool: rayon::ThreadPool,
    slices: Option<SliceOrdered>,
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
        let table = MuTable::new(parameters.hu_law, parameters.energy_kev, parameters.air_below_hu)?;
        let fill_mu_per_m = table.mu_per_m(parameters.fill_hu);
        // One Hounsfield unit of water scaling: that law is stored without rounding.
        let unit_per_m = Material::Water.mu_per_m(parameters.energy_kev)? / 1000.0;
        let slices = match parameters.projector.slice_ordered()? {
            Some(options) => Some(SliceOrdered::new(view, &table, unit_per_m, fill_mu_per_m, options)?),
            None => None,
        };
        let blocks = BlockMap::new(view, &table);
        Ok(Self {
            parameters,
            grid: *view.grid(),
            fill_mu_per_m,
            table,
            intact_blocks: blocks.clone(),
            blocks,
            removed: RemovedVoxels::new(view.grid()),
            blur: gaussian_weights(parameters.detector.blur_sigma_px),
            pool,
            slices,
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
        let Self { slices, removed, pool, .. } = self;
        match slices {
            Some(slices) => pool.install(|| slices.prepare(view, removed, c_arm)).map(|_| ()),
            None => Ok(()),
        }
    }

    /// Bytes of the re-ordered copies and the intermediate image; all 0 where rays are traced one by one.
    pub fn slice_ordered_memory(&self) -> SliceOrderedMemory {
        self.slices.as_ref().map(SliceOrdered::memory).unwrap_or_default()
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

    /// Line integrals of anatomy and tool behind the last frame, row by row; empty before the first.
    pub fn line_integrals(&self) -> &[f64] {
        self.standing.as_ref().map_or(&[], |s| &s.total)
    }

    /// Removes voxels by linear index; those already removed are ignored. Returns how many are new. The order and the grouping into
    /// batches do not matter.
    ///
    /// # Errors
    /// A view of another grid, or an index outside the volume: then the whole batch is refused.
    pub fn remove(&mut self, view: &VolumeView<'_>, batch: &[u32]) -> Result<usize, DrrError> {
        self.check_view(view)?;
        self.removed.check(batch)?;
        let fill_attenuates = self.fill_mu_per_m > 0.0;
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
            self.blocks.mark_drilled(voxel, fill_attenuates);
            if let Some(slices) = &mut self.slices {
                slices.remove(view, linear)?;
            }
            let old_mu = view.hu().get(linear).map_or(0.0, |&hu| self.table.mu_per_m(hu));
            if let Some(marker) = marker.as_mut().filter(|_| old_mu != self.fill_mu_per_m) {
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
        if let Some(slices) = &mut self.slices {
            slices.restore_all(view);
        }
        self.blocks.clone_from(&self.intact_blocks);
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
        self.check_view(view)?;
        c_arm.validate()?;
        if image.len() != c_arm.pixels() {
            return Err(DrrError::Length { field: "image", given: image.len(), expected: c_arm.pixels() });
        }
        let placed = place(tool, c_arm, self.parameters.energy_kev)?;
        let mut standing = match self.standing.take() {
            Some(s) if s.c_arm == *c_arm => s,
            _ => Standing::new(&self.grid, c_arm),
        };
        let (kind, rays_traced) = self.update_anatomy(view, &mut standing)?;
        if kind != RenderKind::Cached {
            standing.window = window_limits(self.parameters.display.window, &standing.anatomy);
        }
        let tool_pixels = self.lay_tool(view, &mut standing, &placed);
        self.pool.install(|| self.expose(&mut standing, seed, image, tool_pixels > 0));
        let window = standing.window;
        self.standing = Some(standing);
        Ok(FrameReport { kind, rays_traced, tool_pixels, window })
    }

    fn check_view(&self, view: &VolumeView<'_>) -> Result<(), DrrError> {
        if *view.grid() == self.grid { Ok(()) } else { Err(DrrError::GridChanged) }
    }

    fn field<'a>(&'a self, view: &VolumeView<'a>) -> AttenuationField<'a> {
        AttenuationField {
            view: *view,
            removed: &self.removed,
            blocks: &self.blocks,
            table: &self.table,
            fill_mu_per_m: self.fill_mu_per_m,
        }
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
        let pixels = standing.c_arm.pixels();
        let fresh = standing.anatomy.is_empty();
        let Self { slices, removed, pool, .. } = self;
        if let Some(slices) = slices.as_mut().filter(|_| fresh || !standing.traced) {
            standing.anatomy.resize(pixels, 0.0);
            let (c_arm, anatomy) = (&standing.c_arm, &mut standing.anatomy);
            if let Some(update) = pool.install(|| slices.project(view, removed, c_arm, anatomy))? {
                standing.traced = false;
                return Ok(match update {
                    Update::Full => (RenderKind::Full, pixels),
                    Update::Changed(b) => {
                        let side = |(first, end): (u32, u32)| (end - first) as usize;
                        (RenderKind::Incremental, side(b.columns) * side(b.rows))
                    }
                    Update::Unchanged => (RenderKind::Cached, 0),
                });
            }
            standing.anatomy.clear();
        }
        Ok(self.trace_anatomy(view, standing))
    }

    /// The same ray by ray.
    fn trace_anatomy(&self, view: &VolumeView<'_>, standing: &mut Standing) -> (RenderKind, usize) {
        let field = self.field(view);
        let columns = standing.c_arm.columns;
        let fan = standing.fan;
        if standing.anatomy.is_empty() {
            standing.anatomy.resize(standing.c_arm.pixels(), 0.0);
            let rows = standing.anatomy.par_chunks_mut(columns as usize).zip(0_u32..standing.c_arm.rows);
            self.pool.install(|| {
                rows.for_each(|(line, row)| {
                    for (value, column) in line.iter_mut().zip(0_u32..) {
                        *value = self.trace(&field, &fan.index_ray(column, row));
                    }
                });
            });
            return (RenderKind::Full, standing.anatomy.len());
        }
        if standing.dirty_list.is_empty() {
            return (RenderKind::Cached, 0);
        }
        let mut list = core::mem::take(&mut standing.dirty_list);
        // Neighbouring rays one after the other share cache lines; the result does not depend on the order.
        list.sort_unstable();
        let one = |&pixel: &u32| self.trace(&field, &fan.index_ray(pixel % columns, pixel / columns));
        let values: Vec<f64> = if list.len() < PARALLEL_FROM {
            list.iter().map(one).collect()
        } else {
            self.pool.install(|| list.par_iter().with_min_len(64).map(one).collect())
        };
        for (&pixel, value) in list.iter().zip(values) {
            standing.anatomy[pixel as usize] = value;
            standing.dirty[pixel as usize] = false;
        }
        let traced = list.len();
        list.clear();
        standing.dirty_list = list;
        (RenderKind::Incremental, traced)
    }

    /// Copies the anatomy and lays the tool over it; returns how many pixels it covers.
    fn lay_tool(&self, view: &VolumeView<'_>, standing: &mut Standing, placed: &[PlacedPart]) -> usize {
        standing.total.clone_from(&standing.anatomy);
        standing.metal.fill(0.0);
        let (first, end) = row_span(placed);
        let width = standing.c_arm.columns as usize;
        let span = first as usize * width..end as usize * width;
        let field = self.field(view);
        let layer =
            ToolLayer { projector: self.parameters.projector, field: &field, fan: &standing.fan, placed };
        let total = standing.total[span.clone()].par_chunks_mut(width);
        let metal = standing.metal[span].par_chunks_mut(width);
        self.pool.install(|| {
            total
                .zip(metal)
                .zip(first..end)
                .map(|((total, metal), row)| layer.draw_row(row, total, metal))
                .sum()
        })
    }

    /// Detector and display.
    fn expose(&self, standing: &mut Standing, seed: FrameSeed, image: &mut [u16], with_tool: bool) {
        let width = standing.c_arm.columns as usize;
        let detector = self.parameters.detector;
        standing.detected.par_chunks_mut(width).zip(standing.total.par_chunks(width)).enumerate().for_each(
            |(row, (detected, total))| {
                for (column, (d, &l)) in detected.iter_mut().zip(total).enumerate() {
                    *d = detector.expose(l, seed, (row * width + column) as u64);
                }
            },
        );
        blur_image(&mut standing.detected, &mut standing.work, width, &self.blur);
        let DisplayParameters { mode, .. } = self.parameters.display;
        let window = standing.window;
        if mode == DisplayMode::BoneBrightToolBlack && with_tool {
            standing.blurred_metal.par_iter_mut().zip(&standing.metal).for_each(|(t, &l)| *t = libm::exp(-l));
            blur_image(&mut standing.blurred_metal, &mut standing.work, width, &self.blur);
        } else {
            standing.blurred_metal.fill(1.0);
        }
        let pixels = standing.detected.par_iter().zip(&standing.blurred_metal);
        image
            .par_iter_mut()
            .zip(pixels)
            .with_min_len(4096)
            .for_each(|(out, (&detected, &metal))| *out = display_value(mode, window, detected, metal));
    }
}

impl Standing {
    fn new(grid: &Grid, c_arm: &CArm) -> Self {
        let pixels = c_arm.pixels();
        Self {
            c_arm: *c_arm,
            fan: RayFan::new(grid, c_arm),
            traced: true,
            anatomy: Vec::new(),
            dirty: vec![false; pixels],
            dirty_list: Vec::new(),
            window: (0.0, 1.0),
            total: vec![0.0; pixels],
            metal: vec![0.0; pixels],
            detected: vec![0.0; pixels],
            work: vec![0.0; pixels],
            blurred_metal: vec![1.0; pixels],
        }
    }
}

/// Blurs along rows, then along columns.
fn blur_image(image: &mut [f64], work: &mut [f64], width: usize, weights: &[f64]) {
    if weights.len() < 2 {
        return;
    }
    work.par_chunks_mut(width)
        .zip(image.par_chunks(width))
        .for_each(|(out, row)| blur_row(row, weights, out));
    let blurred_rows: &[f64] = work;
    image
        .par_chunks_mut(width)
        .enumerate()
        .for_each(|(r, out)| blur_column_into_row(blurred_rows, width, r, weights, out));
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
